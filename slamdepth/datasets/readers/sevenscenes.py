# SPDX-License-Identifier: Apache-2.0
"""The layout of Microsoft's 7-Scenes (Shotton et al., CVPR 2013).

A folder of ``frame-NNNNNN.color.png`` (or jpg), ``frame-NNNNNN.depth.png`` in millimetres
with 0 and 65535 for unknown, and ``frame-NNNNNN.pose.txt``, camera to world, 4x4. The
benchmark names one pinhole for both cameras and never calibrated depth to colour.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets.orientation import exif_orientation, fitted_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import ImageSequence, first_image
from slamdepth.errors import DatasetError
from slamdepth.geometry import orthonormalised
from slamdepth.io import parse_float, read_lines
from slamdepth.types import Camera, Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

FRAME_RATE_HZ = 30.0
DEPTH_FACTOR = 1000.0
UNKNOWN_RAW_DEPTH = (65535,)
CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_factor=DEPTH_FACTOR, fps=FRAME_RATE_HZ)

_ENDINGS = ("color.*", "depth.png", "pose.txt")
_COLOUR_NAME = re.compile(r"(frame-(\d+))\.color\.(png|jpg|jpeg)")


@register_reader
class SevenScenesReader:
    """Opens 7-Scenes folders."""

    name = "7scenes"
    needs = (
        "frame-NNNNNN.color.{png,jpg}; optional frame-NNNNNN.depth.png, frame-NNNNNN.pose.txt, camera.yaml"
    )

    def matches(self, path: Path) -> bool:
        # not any frame-*: ffmpeg writes the images of a video as frame-0001.png
        return any(next(path.glob(f"frame-*.{what}"), None) for what in _ENDINGS)

    def open(self, path: Path, camera: Camera | None) -> ImageSequence:
        notes: list[str] = []
        frames = _find_frames(path)
        if not frames:
            raise DatasetError(f"{path}: no colour images; expected frame-NNNNNN.color.png or .jpg")
        image_paths = tuple(frames.values())
        sample_path, sample_shape = first_image(image_paths)
        camera = _find_camera(path, camera, notes)
        orientation = exif_orientation(sample_path, notes)
        camera = fitted_camera(sample_path, sample_shape, camera, orientation, notes)

        timestamps_s = np.array(list(frames), dtype=np.float64) / FRAME_RATE_HZ
        depth_paths = tuple(_sibling(image, ".depth.png") for image in image_paths)
        with_depth = sum(depth is not None for depth in depth_paths)
        if 0 < with_depth < len(depth_paths):
            notes.append(f"{len(depth_paths) - with_depth} of {len(depth_paths)} frames have no depth image")
        return ImageSequence(
            path.resolve().name,
            path,
            camera,
            timestamps_s,
            image_paths,
            depth_paths,
            _read_poses(image_paths, timestamps_s, notes),
            notes,
            UNKNOWN_RAW_DEPTH,
            orientation=orientation,
        )


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Read a ``(4, 4)`` camera-to-world pose; None where tracking was lost (NaN, infinity, zeros).

    Raises:
        DatasetError: the file does not hold four lines of four numbers; names file and line.
    """
    rows: list[list[float]] = []
    number = 1
    for number, line in read_lines(path):
        try:
            row = [parse_float(text) for text in line.replace(",", " ").split()]
        except ValueError:
            row = []
        if len(row) != 4 or len(rows) == 4:
            raise DatasetError(f"{path}:{number}: expected four lines of four numbers, found {line[:80]!r}")
        rows.append(row)
    if len(rows) != 4:
        raise DatasetError(f"{path}:{number}: expected four lines of four numbers, the file has {len(rows)}")
    T = np.array(rows, dtype=np.float64)
    if not np.isfinite(T).all() or np.abs(T).max() > 1e6 or not np.allclose(T[3], [0, 0, 0, 1], atol=1e-3):
        return None
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-2) or np.linalg.det(R) < 0:
        return None
    T[3] = [0, 0, 0, 1]
    return orthonormalised(T)


def _find_frames(path: Path) -> dict[int, Path]:
    frames: dict[int, Path] = {}
    for image in sorted(path.glob("frame-*.color.*")):
        found = _COLOUR_NAME.fullmatch(image.name)
        if found:
            # Sorted, so a png replaces the jpg of the same frame: it has lost nothing.
            frames[int(found[2])] = image
    return dict(sorted(frames.items()))


def _sibling(image_path: Path, ending: str) -> Path | None:
    path = image_path.with_name(image_path.name.partition(".")[0] + ending)
    return path if path.is_file() else None


def _read_poses(
    image_paths: tuple[Path, ...], timestamps_s: NDArray[np.float64], notes: list[str]
) -> Trajectory | None:
    times_s: list[float] = []
    poses: list[NDArray[np.float64]] = []
    invalid = missing = 0
    for image_path, time_s in zip(image_paths, timestamps_s, strict=True):
        pose_path = _sibling(image_path, ".pose.txt")
        T_world_camera = None if pose_path is None else read_pose(pose_path)
        if T_world_camera is not None:
            times_s.append(float(time_s))
            poses.append(T_world_camera)
        elif pose_path is not None:
            invalid += 1
        else:
            missing += 1
    if invalid:
        notes.append(f"{invalid} invalid poses (NaN, infinity, no rotation) dropped from the ground truth")
    if missing and (poses or invalid):
        notes.append(f"{missing} of {len(image_paths)} frames have no pose.txt")
    return Trajectory(np.array(times_s), np.stack(poses)) if poses else None


def _find_camera(path: Path, camera: Camera | None, notes: list[str]) -> Camera:
    if camera is None and (path / CAMERA_FILE).exists():
        camera = Camera.from_file(path / CAMERA_FILE, notes)
    if camera is None:
        notes.append(
            "intrinsics 585 585 320 240 known by the 7-Scenes layout; depth was never calibrated to colour"
        )
        return CAMERA
    if camera.depth_factor != DEPTH_FACTOR:
        notes.append(
            f"depth factor {DEPTH_FACTOR:g} by the 7-Scenes layout, "
            f"not the {camera.depth_factor:g} of the camera file"
        )
    return replace(camera, depth_factor=DEPTH_FACTOR)
