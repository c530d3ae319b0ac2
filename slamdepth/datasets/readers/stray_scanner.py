# SPDX-License-Identifier: Apache-2.0
"""Recordings of the iOS app Stray Scanner.

``rgb.mp4``, ``camera_matrix.csv`` (3x3, of the video's pixels), ``odometry.csv`` (``timestamp, frame, x, y,
z, qx, qy, qz, qw``: camera to world, with x right, y down, z forward), ``depth/NNNNNN.png`` in millimetres,
of 256x192 pixels with the video's view, and ``confidence/NNNNNN.png`` (0 to 2).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamdepth.datasets.intrinsics import CameraSource
from slamdepth.datasets.orientation import UPRIGHT, turned_camera, turned_image, turned_rotation
from slamdepth.datasets.poses import pose_of, read_matrix, trajectory_of
from slamdepth.datasets.readers.record3d import ARKIT
from slamdepth.datasets.readers.video import VideoSequence
from slamdepth.datasets.recording import camera_for, name_truth, resized_depth
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import is_file
from slamdepth.datasets.video import VideoFile
from slamdepth.errors import CameraError, DatasetError
from slamdepth.geometry import invert
from slamdepth.io import parse_float, read_depth_file, read_depth_m, read_lines
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

_VIDEO, _MATRIX, _ODOMETRY = "rgb.mp4", "camera_matrix.csv", "odometry.csv"
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_MILLIMETRES = 1000.0


@register_reader
class StrayScannerReader:
    """Opens recordings of Stray Scanner."""

    name = "stray-scanner"
    needs = f"{_VIDEO}, {_MATRIX}, {_ODOMETRY}; optional depth, confidence"

    def matches(self, path: Path) -> bool:
        has_lists = (path / _MATRIX).is_file() or (path / _ODOMETRY).is_file()
        return has_lists and (path / _VIDEO).is_file()

    def open(self, path: Path, camera: Camera | None) -> StraySequence:
        notes: list[str] = []
        video = VideoFile(path / _VIDEO)
        shape = (video.height, video.width, 3)
        taken_by, source = camera_for(path, shape, camera, lambda: _camera(path / _MATRIX, video), _MATRIX)
        sequence = StraySequence(path, video, taken_by, notes, source)
        if (path / _ODOMETRY).is_file():
            sequence.take_odometry(_odometry(path / _ODOMETRY))
        return sequence


@dataclass(frozen=True)
class _Odometry:
    """Times ``(N,)`` and poses by the number of the frame."""

    times_s: dict[int, float]
    poses: dict[int, Floats | None]


class StraySequence(VideoSequence):
    """A video with depth images and the poses of ARKit.

    Args:
        taken_by: the camera of upright frames in the video's own size.
    """

    def __init__(
        self, path: Path, video: VideoFile, taken_by: Camera, notes: list[str], source: CameraSource
    ) -> None:
        super().__init__(video, replace(taken_by, depth_factor=_MILLIMETRES), notes, source)
        self.name, self.path = path.resolve().name, path
        self._orientation = video.orientation
        self.has_depth = any(is_file(self._depth_path(index)) for index in range(len(self)))

    def take_odometry(self, odometry: _Odometry) -> None:
        """Take over times and poses of the frames."""
        numbers = range(len(self))
        times_s = np.array([odometry.times_s.get(number, np.nan) for number in numbers])
        if np.isfinite(times_s).all() and (np.diff(times_s) > 0).all():
            self.timestamps_s = times_s
        else:
            self.notes.append(f"{_ODOMETRY} does not time every frame; times are those of the video")
        poses = [odometry.poses.get(number) for number in numbers]
        T_stored_upright = invert(turned_rotation(self._orientation))
        turned = [None if T is None else T @ T_stored_upright for T in poses]
        self.ground_truth = trajectory_of(self.timestamps_s, turned, self.notes)
        name_truth(self, ARKIT)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: the frame, or the depth image asked for, does not decode.
            CameraError: the depth is of another shape than the frame.
        """
        frame = super().read(index)
        path = self._depth_path(index)
        if not with_depth or not is_file(path):
            return frame
        depth_m = read_depth_m(path, _MILLIMETRES)
        confidence_path = self.path / "confidence" / path.name
        if is_file(confidence_path):
            confidence = read_depth_file(confidence_path)
            if confidence.shape == depth_m.shape:
                depth_m[confidence == 0] = 0.0
        if self._orientation != UPRIGHT:
            depth_m = turned_image(depth_m, self._orientation)
        return replace(frame, depth_m=resized_depth(depth_m, self.camera, str(path)))

    def files(self) -> Iterable[Path]:
        """See :meth:`slamdepth.datasets.base.Dataset.files`."""
        depth = (self._depth_path(index) for index in range(len(self)))
        return (self.path / _VIDEO, *(path for path in depth if is_file(path)))

    def _depth_path(self, index: int) -> Path:
        return self.path / "depth" / f"{index:06d}.png"


def _camera(path: Path, video: VideoFile) -> Camera | None:
    if not path.is_file():
        return None
    K = read_matrix(path, 3, rows=3)
    is_turned = video.orientation >= 5
    size = (video.height, video.width) if is_turned else (video.width, video.height)
    try:
        camera = Camera(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], depth_factor=_MILLIMETRES, fps=video.fps)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
    return camera if video.orientation == UPRIGHT else turned_camera(camera, video.orientation)


def _odometry(path: Path) -> _Odometry:
    lines = read_lines(path)
    header = [name.strip() for name in lines[0][1].split(",")] if lines else []
    if not set(_COLUMNS) <= set(header):
        raise DatasetError(f"{path}: its first line must name the columns {', '.join(_COLUMNS)}")
    at = [header.index(name) for name in _COLUMNS]
    found = _Odometry({}, {})
    for number, line in lines[1:]:
        fields = [field.strip() for field in line.split(",")]
        try:
            row = np.array([parse_float(fields[index]) for index in at])
            frame = int(fields[at[1]])
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}:{number}: expected {len(header)} numbers, found {line[:80]!r}"
            ) from error
        found.times_s[frame] = float(row[0])
        found.poses[frame] = pose_of(row[2:5], row[5:])
    return found
