# SPDX-License-Identifier: Apache-2.0
"""Tiny synthetic training data in every layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamdepth.datasets import write_camera
from slamdepth.datasets.readers import sevenscenes
from slamdepth.training.readers import hypersim
from slamdepth.types import Camera


def make_place(folder: Path, count: int = 4, width: int = 64, height: int = 48) -> Path:
    """Pairs whose brightness encodes the depth."""
    folder.mkdir(parents=True)
    about = {"width": width, "height": height, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
    (folder / "camera.json").write_text(json.dumps({**about, "depth_unit_m": 0.001}))
    rng = np.random.default_rng(0)
    for k in range(count):
        grey = cv2.resize(rng.uniform(40, 220, (3, 4)), (width, height))
        cv2.imwrite(str(folder / f"{k:05d}.jpg"), np.repeat(grey[:, :, None], 3, 2).astype(np.uint8))
        depth = np.round(500 + 10 * grey).astype(np.uint16)
        depth[:4] = 0
        cv2.imwrite(str(folder / f"{k:05d}.png"), depth)
    return folder


NORMAL, DISTANCE_M = np.array([0.2, -0.3, 0.9]), 2.0
"""The plane every sequence below looks at: ``NORMAL . X = DISTANCE_M``."""


def plane_frame(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Raw image ``(H, W, 3)`` and depth ``(H, W)`` metres of the plane through the lens of ``camera``."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    px = camera.undistort_points(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
    rays = np.column_stack([(px - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(px))])
    depth = (DISTANCE_M / (rays @ NORMAL)).reshape(camera.height, camera.width)
    return np.repeat((depth * 60).astype(np.uint8)[..., None], 3, 2), depth.astype(np.float32)


def make_tum(folder: Path, camera: Camera, count: int = 3) -> Path:
    """A TUM folder; its first colour image has no depth within reach."""
    image, depth = plane_frame(camera)
    raw = np.round(depth * camera.depth_factor).astype(np.uint16)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in range(count):
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), image)
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), raw)
    lines = {"rgb": [f"{k} rgb/{k}.png" for k in range(count)]}
    lines["depth"] = [f"{k + (0.5 if k == 0 else 0.01)} depth/{k}.png" for k in range(count)]
    for kind, listed in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(listed) + "\n")
    write_camera(folder / "camera.yaml", camera)
    return folder


def make_sevenscenes(folder: Path, count: int = 2) -> Path:
    folder.mkdir(parents=True)
    image, depth = plane_frame(sevenscenes.CAMERA)
    raw = np.round(depth * 1000).astype(np.uint16)
    raw[:10] = 65535
    for k in range(count):
        cv2.imwrite(str(folder / f"frame-{k:06d}.color.png"), image)
        cv2.imwrite(str(folder / f"frame-{k:06d}.depth.png"), raw)
    return folder


def make_hypersim(folder: Path, count: int = 2, width: int = 128, height: int = 96) -> Path:
    """A scene of two cameras; one image is a tonemap, one a colour preview, one is missing."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'slamdepth[hypersim]'")
    focal = hypersim.FOCAL_PX * width / hypersim.WIDTH_PX
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    image, depth = plane_frame(camera)
    u, v = np.meshgrid(np.arange(width) - camera.cx, np.arange(height) - camera.cy)
    distance = depth * np.sqrt(u**2 + v**2 + focal**2) / focal
    distance[0, :3] = np.nan, np.inf, -1
    for cam, kind in ((0, "tonemap"), (1, "color")):
        images = folder / "images" / f"scene_cam_{cam:02d}_final_preview"
        geometry = folder / "images" / f"scene_cam_{cam:02d}_geometry_hdf5"
        images.mkdir(parents=True)
        geometry.mkdir()
        for k in range(count):
            cv2.imwrite(str(images / f"frame.{k:04d}.{kind}.jpg"), image)
            with h5py.File(geometry / f"frame.{k:04d}.depth_meters.hdf5", "w") as file:
                file["dataset"] = distance.astype(np.float16)
    (folder / "images" / "scene_cam_01_final_preview" / "frame.0001.color.jpg").unlink()
    return folder


def tiny_settings(folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Settings of a training of seconds, with a place held out; its cache is below ``folder``."""
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(folder / "cache"))
    make_place(folder / "data" / "room")
    make_place(folder / "data" / "other", 2)
    return {
        "output": str(folder / "head.safetensors"),
        "members": 2,
        "coarse_epochs": 2,
        "fine_epochs": 1,
        "batch": 4,
        "sources": [
            {
                "folder": str(folder / "data"),
                "places": [{"name": "room", "samples": 8}],
                "held_out": ["other"],
            },
        ],
        "view": {"rows": 28, "columns": 42},
        "head": {"taps": [0, 1], "dim": 16, "guide_dim": 8},
    }


def interrupted_at(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, call: int) -> list[int]:
    """Make a function of ``module`` raise KeyboardInterrupt at its call of this number, counted from 1.

    Returns:
        A list that gets an element at each call.
    """
    real, calls = getattr(module, name), list[int]()

    def dies(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    monkeypatch.setattr(module, name, dies)
    return calls
