# SPDX-License-Identifier: Apache-2.0
"""The raw data that the app Polycam exports (developer mode).

``keyframes/images/N.jpg`` with ``keyframes/cameras/N.json`` each: fx, fy, cx, cy, width, height and ``t_00``
to ``t_23``, camera to world by rows, with x right, y up, z backward. Where Polycam has optimised the capture,
``corrected_images`` and ``corrected_cameras`` are better. ``keyframes/depth/N.png`` is in millimetres, of
fewer pixels than the image.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.image_files import has_images, list_images
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

_FPS = 10.0
_TRUTH = "poses of ARKit, corrected by Polycam where it did, not measured by a second system"
_LENS = ("width", "height", "fx", "fy", "cx", "cy")


@register_reader
class PolycamReader:
    """Opens raw exports of Polycam."""

    name = "polycam"
    needs = "keyframes/images/N.jpg and keyframes/cameras/N.json"

    def matches(self, path: Path) -> bool:
        root = _root(path)
        return any(
            (root / f"{kind}cameras").is_dir() and (root / f"{kind}images").is_dir() for kind in _KINDS
        )

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        notes: list[str] = []
        root = _root(path)
        kind = next((one for one in _KINDS if has_images(root / f"{one}images")), None)
        if kind is None or not (root / f"{kind}cameras").is_dir():
            raise DatasetError(f"{root}: no images, or no cameras next to them")
        images, files = [], []
        for image in list_images(root / f"{kind}images"):
            file = root / f"{kind}cameras" / f"{image.stem}.json"
            if is_file(file):
                images.append(image)
                files.append(_values(file))
        if not images:
            raise DatasetError(f"{root}: no image in {kind}images has a file in {kind}cameras")
        _, shape = first_image(tuple(images))
        taken_by, source = camera_for(
            path, shape, camera, lambda: _camera(root, files, shape, notes), f"{kind}cameras of Polycam"
        )
        times_s = counted_times(len(images), _FPS, notes)
        truth = trajectory_of(times_s, [_pose(values) for values in files], notes)
        depths = [root / "depth" / f"{image.stem}.png" for image in images]
        recording = FileRecording(
            path.resolve().name, path, taken_by, times_s, images, truth=truth, notes=notes, source=source,
            depth_paths=[depth if is_file(depth) else None for depth in depths],
        )  # fmt: skip
        name_truth(recording, _TRUTH)
        return recording


_KINDS = ("corrected_", "")


def _root(path: Path) -> Path:
    return path / "keyframes" if (path / "keyframes").is_dir() else path


def _values(file: Path) -> dict[str, float]:
    """The numbers of a camera's file by their names."""
    values: Any = read_json(file)
    if not isinstance(values, dict):
        raise DatasetError(f"{file}: must be a mapping of keys to numbers")
    numbers: dict[str, float] = {}
    for name, value in values.items():
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12:
            numbers[str(name)] = float(value)
    missing = [name for name in _LENS if name not in numbers]
    if missing:
        raise CameraError(f"{file}: {missing[0]!r} must be a number")
    return numbers


def _camera(root: Path, files: list[dict[str, float]], shape: tuple[int, ...], notes: list[str]) -> Camera:
    """The camera of the middle one by its focal length."""
    lens = files[middle_focal(np.array([values["fx"] for values in files]), "fx", notes)]
    calibration = {
        "image_width": round(lens["width"]),
        "image_height": round(lens["height"]),
        "camera_matrix": [[lens["fx"], 0.0, lens["cx"]], [0.0, lens["fy"], lens["cy"]], [0.0, 0.0, 1.0]],
        "depth_factor": 1000.0,
    }
    return recorded_camera(root, calibration, shape, notes)


def _pose(values: dict[str, float]) -> Floats | None:
    rows = [[values.get(f"t_{row}{column}", math.nan) for column in range(4)] for row in range(3)]
    T = np.vstack([np.array(rows), [[0.0, 0.0, 0.0, 1.0]]])
    return None if np.isnan(T).any() else np.asarray(T @ OPENCV_OF_OPENGL)
