# SPDX-License-Identifier: Apache-2.0
"""Tiny sequence folders for the tests of readers and converters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slamdepth.datasets import write_camera
from slamdepth.types import Camera

CAMERA = Camera(16, 12, 20.0, 21.0, 7.5, 5.5)


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Write an RGB, grey or depth image without cv2's guesses about paths."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., ::-1]
    ok, data = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(data.tobytes())


def imread(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """``cv2.imread`` of a file that must decode; colours are BGR."""
    image = cv2.imread(str(path), flags)
    assert image is not None, f"{path} does not decode"
    return image


def image_rgb(seed: int, camera: Camera = CAMERA) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)


def depth_raw(seed: int, camera: Camera = CAMERA) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(1, 30000, (camera.height, camera.width), dtype=np.uint16)


def poses(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Random rigid transforms ``(count, 4, 4)``."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def make_tum(folder: Path, count: int = 4, *, camera_file: bool = True) -> Path:
    """A whole TUM folder: colour every 0.1 s from 10 s, depth 5 ms later, ground truth at each image."""
    for i in range(count):
        write_image(folder / "rgb" / f"{i}.png", image_rgb(i))
        write_image(folder / "depth" / f"{i}.png", depth_raw(i))
    times = [10 + 0.1 * i for i in range(count)]
    (folder / "rgb.txt").write_text("# c\n" + "".join(f"{t:.6f} rgb/{i}.png\n" for i, t in enumerate(times)))
    (folder / "depth.txt").write_text(
        "".join(f"{t + 0.005:.6f} depth/{i}.png\n" for i, t in enumerate(times))
    )
    (folder / "groundtruth.txt").write_text(
        "".join(f"{t:.6f} {i} 0 0 0 0 0 1\n" for i, t in enumerate(times))
    )
    if camera_file:
        write_camera(folder / "camera.yaml", CAMERA)
    return folder


def make_sevenscenes(folder: Path, count: int = 3, ending: str = "png") -> Path:
    """A whole 7-Scenes folder with full-size images and random poses."""
    camera = Camera(640, 480, 585, 585, 320, 240)
    T_world_camera = poses(count)
    for i in range(count):
        stem = f"frame-{i:06d}"
        write_image(folder / f"{stem}.color.{ending}", np.full((480, 640, 3), 10 * i, np.uint8))
        raw = np.full((camera.height, camera.width), 1000 + i, np.uint16)
        raw[0, 0], raw[0, 1] = 0, 65535
        write_image(folder / f"{stem}.depth.png", raw)
        np.savetxt(folder / f"{stem}.pose.txt", T_world_camera[i], delimiter="\t ")
    return folder
