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
from slamdepth.datasets.poses import read_matrix, trajectory_of
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.sequence import ImageSequence, first_image
from slamdepth.errors import DatasetError
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
    paths = (_sibling(image_path, ".pose.txt") for image_path in image_paths)
    poses = [None if path is None else read_matrix(path, 4, rows=4) for path in paths]
    return trajectory_of(timestamps_s, poses, notes, missing="pose.txt")


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
