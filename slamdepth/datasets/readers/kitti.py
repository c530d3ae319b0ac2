# SPDX-License-Identifier: Apache-2.0
"""A sequence of KITTI odometry (Geiger et al., CVPR 2012): ``sequences/NN``, its left camera.

``image_2`` (colour) or ``image_0`` (grey), ``times.txt``, ``calib.txt`` with the projections ``P0`` to ``P3``
of the rectified cameras, and ``../../poses/NN.txt`` with twelve numbers a frame, the pose of the grey left
camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.datasets.image_files import has_images, list_images
from slamdepth.datasets.poses import read_matrix, trajectory_of
from slamdepth.datasets.recording import FileRecording, camera_for, counted_times
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import first_image
from slamdepth.errors import DatasetError
from slamdepth.io import parse_float, read_lines
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Floats

_FPS = 10.0
_CAMERAS = ("image_2", "image_0")


@register_reader
class KittiReader:
    """Opens sequences of KITTI odometry."""

    name = "kitti"
    needs = "image_2 or image_0, calib.txt, times.txt; optional ../../poses/NN.txt"

    def matches(self, path: Path) -> bool:
        has_files = (path / "calib.txt").is_file() or (path / "times.txt").is_file()
        return has_files and any((path / name).is_dir() for name in _CAMERAS)

    def open(self, path: Path, camera: Camera | None) -> FileRecording:
        notes: list[str] = []
        folder = next((path / name for name in _CAMERAS if has_images(path / name)), None)
        if folder is None:
            raise DatasetError(f"{path}: no images in {' or '.join(_CAMERAS)}")
        images = list_images(folder)
        numbers = _numbers(images)
        timestamps_s, images, numbers = _times(path, images, numbers, notes)
        _, shape = first_image(tuple(images))
        projection = _projection(path / "calib.txt", f"P{folder.name[-1]}")
        taken_by, source = camera_for(path, shape, camera, lambda: _camera(projection, shape), "calib.txt")
        truth = _truth(path, numbers, timestamps_s, projection, notes)
        notes.append(f"images of {folder.name}")
        name = f"kitti_{path.resolve().name}"
        return FileRecording(
            name, path, taken_by, timestamps_s, images, truth=truth, notes=notes, source=source
        )


def _numbers(images: list[Path]) -> list[int]:
    """Frame numbers by the images' names, or counted where those are no numbers."""
    stems = [image.stem for image in images]
    if all(stem.isdecimal() and len(stem) < 12 for stem in stems):
        return [int(stem) for stem in stems]
    return list(range(len(images)))


def _times(
    path: Path, images: list[Path], numbers: list[int], notes: list[str]
) -> tuple[Floats, list[Path], list[int]]:
    if not (path / "times.txt").is_file():
        return counted_times(len(images), _FPS, notes), images, numbers
    table_s = read_matrix(path / "times.txt", 1)[:, 0]
    kept = [i for i, number in enumerate(numbers) if number < len(table_s)]
    if not kept:
        raise DatasetError(f"{path / 'times.txt'}: has {len(table_s)} times, none of an image")
    if len(kept) < len(images):
        notes.append(f"{len(images) - len(kept)} images have no time and are left out")
    times_s = table_s[[numbers[i] for i in kept]]
    if not (np.isfinite(times_s).all() and (np.diff(times_s) > 0).all()):
        raise DatasetError(f"{path / 'times.txt'}: times do not increase")
    return times_s, [images[i] for i in kept], [numbers[i] for i in kept]


def _projection(path: Path, name: str) -> Floats | None:
    """``(3, 4)`` of a camera by ``calib.txt``; None where there is no such file.

    Raises:
        DatasetError: the file has no such projection, or it is none.
    """
    if not path.is_file():
        return None
    for number, line in read_lines(path):
        key, _, rest = line.partition(":")
        if key.strip() != name:
            continue
        try:
            P = np.array([parse_float(text) for text in rest.split()]).reshape(3, 4)
        except ValueError:
            P = np.zeros((3, 4))
        if not (np.isfinite(P).all() and P[0, 0] > 0 and P[1, 1] > 0):
            raise DatasetError(f"{path}:{number}: expected '{name}:' and twelve numbers of a projection")
        return P
    raise DatasetError(f"{path}: no line '{name}:' with twelve numbers")


def _camera(projection: Floats | None, shape: tuple[int, ...]) -> Camera | None:
    if projection is None:
        return None
    K = projection[:, :3]
    return Camera(shape[1], shape[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2], fps=_FPS)


def _truth(
    path: Path, numbers: list[int], timestamps_s: Floats, projection: Floats | None, notes: list[str]
) -> Trajectory | None:
    place = path.resolve()
    files = (place / "poses.txt", place.parent.parent / "poses" / f"{place.name}.txt")
    file = next((one for one in files if one.is_file()), None)
    if file is None:
        return None
    rows = read_matrix(file, 12).reshape(-1, 3, 4)
    T_grey_camera = np.eye(4)
    if projection is not None:
        # A rectified camera's projection is K [I | t]: it sees what the first one sees, moved by t.
        T_grey_camera[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    last = np.array([[0.0, 0.0, 0.0, 1.0]])
    poses = [np.vstack([rows[n], last]) @ T_grey_camera if n < len(rows) else None for n in numbers]
    return trajectory_of(timestamps_s, poses, notes)
