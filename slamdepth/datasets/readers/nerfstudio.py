# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of nerfstudio, instant-ngp, Polycam and Blender's NeRF scenes.

Poses are camera to world with x right, y up, z backward. Intrinsics are ``fl_x fl_y cx cy w h`` (pixel
corners at whole numbers, as in COLMAP) or ``camera_angle_x``, for all frames or each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.image_files import IMAGE_ENDINGS, natural_key
from slamdepth.datasets.poses import OPENCV_OF_OPENGL, trajectory_of
from slamdepth.datasets.recording import (
    FileRecording,
    camera_for,
    counted_times,
    middle_focal,
    name_truth,
    recorded_camera,
)
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image, is_file
from slamdepth.errors import CameraError, DatasetError
from slamdepth.io import read_json
from slamdepth.types import Camera
from slamdepth.typing import Floats

_NAMES = ("transforms.json", "transforms_train.json")
_FPS = 30.0
_TRUTH = "poses of transforms.json, of COLMAP or a scanner, and of an unknown unit"
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
_LENS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "camera_angle_x",
    "camera_angle_y",
    "w",
    "h",
)


@register_reader
class NerfstudioReader:
    """Opens folders with ``transforms.json``, or the file itself."""

    name = "nerfstudio"
    needs = "transforms.json and the images it names"

    def matches(self, path: Path) -> bool:
        if path.is_file():
            return path.suffix == ".json" and path.name.startswith("transforms")
        return not (path / "rgb.txt").exists() and any((path / name).is_file() for name in _NAMES)

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        file = path if path.is_file() else next(path / name for name in _NAMES if (path / name).is_file())
        notes: list[str] = []
        values = read_json(file)
        frames = _frames(file, values, notes)
        images = [frame.image for frame in frames]
        _, shape = first_image(tuple(images))
        taken_by, source = camera_for(
            path, shape, camera, lambda: _camera(file, values, frames, shape, notes), file.name
        )
        times_s = counted_times(len(frames), _FPS, notes)
        truth = trajectory_of(times_s, [frame.T_world_camera for frame in frames], notes, is_metric=False)
        recording = FileRecording(
            file.parent.resolve().name, file.parent, taken_by, times_s, images, truth=truth, notes=notes,
            source=source, depth_paths=[frame.depth for frame in frames],
        )  # fmt: skip
        name_truth(recording, _TRUTH)
        return recording


@dataclass(frozen=True)
class _Frame:
    image: Path
    depth: Path | None
    T_world_camera: Floats | None
    values: dict[str, Any]


def _frames(file: Path, values: Any, notes: list[str]) -> list[_Frame]:
    entries = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{file}: has no list 'frames'")
    found: dict[str, _Frame] = {}
    for number, entry in enumerate(entries):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name.strip() or "\0" in name:
            raise DatasetError(f"{file}: frame {number} has no 'file_path'")
        depth = entry.get("depth_file_path")
        depth_path = file.parent / depth if isinstance(depth, str) and depth and "\0" not in depth else None
        pose = _pose(file, number, entry.get("transform_matrix"))
        is_there = depth_path is not None and is_file(depth_path)
        found[name] = _Frame(_image(file.parent, name), depth_path if is_there else None, pose, entry)
    if len(found) < len(entries):
        notes.append(f"{file.name}: {len(entries) - len(found)} frames name an image again and are left out")
    names = sorted(found, key=lambda name: (natural_key(name), name))
    frames = [found[name] for name in names if is_file(found[name].image)]
    if not frames:
        raise DatasetError(
            f"{file}: none of its {len(names)} images exists; the first: {found[names[0]].image}"
        )
    if len(frames) < len(names):
        notes.append(f"{file.name}: {len(names) - len(frames)} of {len(names)} images do not exist")
    return frames


def _image(folder: Path, name: str) -> Path:
    """The image of a frame; Blender's scenes leave the ending out."""
    path = folder / name
    if is_file(path):
        return path
    endings = (path.with_name(path.name + ending) for ending in IMAGE_ENDINGS)
    return next((one for one in endings if is_file(one)), path)


def _pose(file: Path, number: int, value: Any) -> Floats | None:
    if value is None:
        return None
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        T = np.zeros(0)
    if T.shape == (3, 4):
        T = np.vstack([T, [[0.0, 0.0, 0.0, 1.0]]])
    if T.shape != (4, 4):
        raise DatasetError(f"{file}: 'transform_matrix' of frame {number} must be 4 x 4 numbers")
    with np.errstate(all="ignore"):
        return np.asarray(T @ OPENCV_OF_OPENGL)


def _camera(
    file: Path, values: dict[str, Any], frames: list[_Frame], shape: tuple[int, ...], notes: list[str]
) -> Camera | None:
    """One camera for all frames; None where the file says nothing of it."""
    cameras = [_lens(file, {**values, **frame.values}) for frame in frames]
    focals = np.array([lens["fl_x"] for lens in cameras if "fl_x" in lens])
    if len(focals) == 0:
        return None
    lens = dict(cameras[middle_focal(focals, f"{file.name}: fl_x", notes)])
    height, width = shape[:2]
    if "w" not in lens or "h" not in lens:
        lens["w"], lens["h"] = float(width), float(height)
    model = str(values.get("camera_model") or "OPENCV").upper()
    is_fisheye = model in _FISHEYE or values.get("is_fisheye") is True
    if not is_fisheye and model not in _PINHOLES:
        raise CameraError(f"{file}: camera_model {model[:40]!r} is not supported")
    names = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3")
    fx, fy = lens["fl_x"], lens.get("fl_y", lens["fl_x"])
    # The file's pixels have their corners at whole numbers, ours their centres.
    cx, cy = lens.get("cx", lens["w"] / 2.0) - 0.5, lens.get("cy", lens["h"] / 2.0) - 0.5
    calibration = {
        "image_width": round(lens["w"]),
        "image_height": round(lens["h"]),
        "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion_model": "equidistant" if is_fisheye else "plumb_bob",
        "distortion_coefficients": [lens.get(name, 0.0) for name in names],
        "depth_factor": _depth_factor(file, values),
    }
    return recorded_camera(file, calibration, shape, notes)


def _lens(file: Path, values: dict[str, Any]) -> dict[str, float]:
    """Numbers of a lens by their names in the file; focal lengths of angles among them."""
    lens: dict[str, float] = {}
    for name in _LENS:
        value = values.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
            raise CameraError(f"{file}: {name!r} must be a number, found {str(value)[:40]!r}")
        lens[name] = float(value)
    for focal, angle, side in (("fl_x", "camera_angle_x", "w"), ("fl_y", "camera_angle_y", "h")):
        if focal not in lens and side in lens and 0.0 < lens.get(angle, 0.0) < math.pi:
            lens[focal] = lens[side] / (2.0 * math.tan(lens[angle] / 2.0))
    if min(lens.get("w", 1.0), lens.get("h", 1.0)) < 1.0:
        raise CameraError(f"{file}: 'w' and 'h' must be positive")
    return lens


def _depth_factor(file: Path, values: dict[str, Any]) -> float:
    unit = values.get("depth_unit_scale_factor", 1e-3)
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 1e-9 < unit < 1e9:
        raise CameraError(
            f"{file}: 'depth_unit_scale_factor' must be a positive number, found {str(unit)[:40]!r}"
        )
    return 1.0 / float(unit)
