# SPDX-License-Identifier: Apache-2.0
"""From a depth map to colours and points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.datasets.intrinsics import Certainty, Intrinsics
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.geometry import backproject
from slamdepth.io import write_point_cloud
from slamdepth.report.depth_map import Scale, known_pixels
from slamdepth.types import DepthKind, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray


def frame_scale(near: float, far: float, model: DepthModel, entry: dict[str, Any]) -> Scale:
    """The colour scale of a journal ``entry``, with a caution where its metres rest on a guess."""
    is_predicted = model.kind is DepthKind.METRIC and not is_sensor(model)
    is_guess = is_predicted and entry["certainty"] == Certainty.GUESSED.value
    return Scale(near, far, model.kind, "metres rest on a guessed focal length" if is_guess else "")


def common_range(entries: list[dict[str, Any]], kind: DepthKind) -> tuple[float, float]:
    """One near and far end for all frames: the 5th and 95th percentile of their own ends."""
    towards_near, towards_far = (95, 5) if kind is DepthKind.AFFINE_INVERSE_DEPTH else (5, 95)
    near = np.percentile([entry["near"] for entry in entries], towards_near)
    far = np.percentile([entry["far"] for entry in entries], towards_far)
    return float(near), float(far)


def write_cloud(
    path: Path, frame: Frame, depth_m: NDArray[np.float32], intrinsics: Intrinsics, model: str
) -> int:
    """Write every known pixel of ``depth_m (H, W)`` metres as a coloured point in the camera frame.

    Returns:
        The number of points.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    rows, columns = np.nonzero(known_pixels(depth_m, DepthKind.METRIC))
    raw_px = np.stack([columns, rows], axis=1).astype(np.float64)
    points_px = frame.camera.undistort_points(raw_px)
    points_m = backproject(frame.camera, points_px, depth_m[rows, columns].astype(np.float64))
    comments = [
        f"metres, camera frame: x right, y down, z forward; depth by {model}",
        f"intrinsics: {intrinsics.how}",
    ]
    write_point_cloud(path, points_m, frame.image_rgb[rows, columns], comments)
    return len(points_m)
