# SPDX-License-Identifier: Apache-2.0
"""ScanNet (Dai et al., CVPR 2017) as its SensReader exports it.

``color/N.jpg``, ``depth/N.png`` (millimetres), ``pose/N.txt`` (camera to world, 4x4, -inf where tracking was
lost) and ``intrinsic/intrinsic_color.txt`` (4x4). Depth has fewer pixels than colour and about the same view.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.datasets.image_files import has_images, list_images
from slamdepth.datasets.poses import read_matrix, trajectory_of
from slamdepth.datasets.recording import FileRecording, camera_for, name_truth
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image, is_file
from slamdepth.errors import CameraError, DatasetError
from slamdepth.types import Camera
from slamdepth.typing import Floats

FPS = 30.0
MILLIMETRES = 1000.0
TRUTH = "poses of BundleFusion, not measured by a second system"
_OFF_CENTRE = 0.2
"""A principal point that is off the middle by more, as a share of the side, is of another image size."""


@register_reader
class ScanNetReader:
    """Opens exported ScanNet scenes."""

    name = "scannet"
    needs = "color/N.jpg, intrinsic/intrinsic_color.txt; optional depth/N.png, pose/N.txt"

    def matches(self, path: Path) -> bool:
        return (path / "color").is_dir() and ((path / "pose").is_dir() or (path / "intrinsic").is_dir())

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        notes: list[str] = []
        if not has_images(path / "color"):
            raise DatasetError(f"{path / 'color'}: no images")
        images = [image for image in list_images(path / "color") if _is_number(image.stem)]
        if not images:
            raise DatasetError(f"{path / 'color'}: no images that are named by a number")
        _, shape = first_image(tuple(images))
        taken_by, source = camera_for(
            path,
            shape,
            camera,
            lambda: _camera(path / "intrinsic", shape, notes),
            "intrinsic/intrinsic_color.txt",
        )
        times_s = np.array([int(image.stem) for image in images], dtype=np.float64) / FPS
        if not (np.diff(times_s) > 0).all():
            raise DatasetError(f"{path / 'color'}: two images have the same number")
        depths = [path / "depth" / f"{image.stem}.png" for image in images]
        files = [path / "pose" / f"{image.stem}.txt" for image in images]
        poses = [read_matrix(file, 4, rows=4) if is_file(file) else None for file in files]
        truth = trajectory_of(times_s, poses, notes)
        recording = FileRecording(
            path.resolve().name, path, taken_by, times_s, images, truth=truth, notes=notes, source=source,
            depth_paths=[depth if is_file(depth) else None for depth in depths],
        )  # fmt: skip
        name_truth(recording, TRUTH)
        return recording


def _is_number(stem: str) -> bool:
    return stem.isdecimal() and len(stem) < 10


def _camera(folder: Path, shape: tuple[int, ...], notes: list[str]) -> Camera | None:
    for name in ("intrinsic_color.txt", "intrinsic_depth.txt"):
        if not is_file(folder / name):
            continue
        K = read_matrix(folder / name, 4, rows=4)
        camera = camera_of(folder / name, K, shape)
        if camera is not None:
            if "depth" in name:
                notes.append(
                    "intrinsics of the depth camera fit the size of the images, those of colour do not"
                )
            return camera
    return None


def camera_of(path: Path, K: Floats, shape: tuple[int, ...]) -> Camera | None:
    """The camera of images of ``shape`` with the matrix ``K``; None where its centre is that of other images.

    Raises:
        CameraError: it is no matrix of a camera.
    """
    height, width = shape[:2]
    try:
        camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], depth_factor=MILLIMETRES, fps=FPS)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
    off = max(abs(camera.cx / width - 0.5), abs(camera.cy / height - 0.5))
    return camera if off < _OFF_CENTRE else None
