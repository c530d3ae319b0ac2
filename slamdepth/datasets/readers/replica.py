# SPDX-License-Identifier: Apache-2.0
"""Replica as NICE-SLAM renders it (Zhu et al., CVPR 2022).

``results/frameNNNNNN.jpg``, ``results/depthNNNNNN.png``, ``traj.txt`` with sixteen numbers a frame (camera to
world, by rows), and ``cam_params.json`` in the folder above.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.poses import read_matrix, trajectory_of
from slamdepth.datasets.recording import FileRecording, camera_for, counted_times
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image, is_file
from slamdepth.errors import CameraError, DatasetError
from slamdepth.io import read_json
from slamdepth.types import Camera

KNOWN = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5, depth_factor=6553.5)
"""What NICE-SLAM's ``cam_params.json`` says."""
_FPS = 30.0
_FRAME = re.compile(r"frame(\d{1,9})\.(?:jpg|png)")


@register_reader
class ReplicaReader:
    """Opens Replica sequences of NICE-SLAM."""

    name = "replica"
    needs = "results/frame*.jpg, results/depth*.png, traj.txt; cam_params.json there or above"

    def matches(self, path: Path) -> bool:
        return next((path / "results").glob("frame*.*"), None) is not None

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        notes: list[str] = []
        matched = {image: _FRAME.fullmatch(image.name) for image in sorted((path / "results").iterdir())}
        frames = {int(name[1]): image for image, name in matched.items() if name}
        if not frames:
            raise DatasetError(f"{path / 'results'}: no images frameNNNNNN.jpg")
        numbers = sorted(frames)
        images = [frames[number] for number in numbers]
        _, shape = first_image(tuple(images))
        params = next(
            (one for one in (path / "cam_params.json", path.parent / "cam_params.json") if is_file(one)), None
        )
        how = "known by the layout of NICE-SLAM" if params is None else params.name
        taken_by, source = camera_for(path, shape, camera, lambda: _camera(params, shape), how)
        times_s = counted_times(max(numbers) + 1, _FPS, notes)[numbers]
        depths = [image.with_name(f"depth{image.stem.removeprefix('frame')}.png") for image in images]
        truth = None
        if is_file(path / "traj.txt"):
            rows = read_matrix(path / "traj.txt", 16).reshape(-1, 4, 4)
            truth = trajectory_of(times_s, [rows[n] if n < len(rows) else None for n in numbers], notes)
        recording = FileRecording(
            path.resolve().name, path, taken_by, times_s, images, truth=truth, notes=notes, source=source,
            depth_paths=[depth if is_file(depth) else None for depth in depths],
        )  # fmt: skip
        recording.truth_source = "exact, by the renderer"
        return recording


def _camera(path: Path | None, shape: tuple[int, ...]) -> Camera | None:
    """The camera by ``cam_params.json``; where there is none, the known one if it fits the images."""
    if path is None:
        return KNOWN if shape[:2] == (KNOWN.height, KNOWN.width) else None
    values: Any = read_json(path)
    values = values.get("camera") if isinstance(values, dict) else None
    names = ("w", "h", "fx", "fy", "cx", "cy", "scale")
    numbers = [values.get(name) if isinstance(values, dict) else None for name in names]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and np.isfinite(n) for n in numbers):
        raise CameraError(f"{path}: expected 'camera' with the numbers {', '.join(names)}")
    width, height, fx, fy, cx, cy, scale = (float(number) for number in numbers)  # type: ignore[arg-type]
    try:
        return Camera(int(width), int(height), fx, fy, cx, cy, depth_factor=scale, fps=_FPS)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
