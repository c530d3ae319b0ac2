# SPDX-License-Identifier: Apache-2.0
"""Point clouds from depth images."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import CameraError, TrackingError
from slamdepth.types import Camera
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


def depth_to_cloud(
    depth_m: NDArray[np.floating],
    camera: Camera,
    *,
    stride: int = 4,
    min_m: float = 0.2,
    max_m: float = 5.0,
    max_jump: float = 0.03,
) -> Floats:
    """Points of a depth image, undistorted and without pixels on depth edges.

    Args:
        depth_m: ``(H, W)`` metres along z, 0 = unknown, in raw pixels of ``camera``.
        stride: every ``stride``-th pixel of every ``stride``-th row is taken.
        min_m, max_m: depth outside is dropped.
        max_jump: a pixel is dropped where the known depth of a direct neighbour differs
            by more than this share; such pixels float between foreground and background.

    Returns:
        ``(N, 3)`` points in the camera frame, metres.

    Raises:
        CameraError: the image is not of the camera's size.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise CameraError(f"depth image is {depth_m.shape}, the camera says {(camera.height, camera.width)}")
    first = stride // 2
    rows, columns = np.arange(first, camera.height, stride), np.arange(first, camera.width, stride)
    z = depth_m[np.ix_(rows, columns)].astype(np.float64)
    keep = (z > min_m) & (z < max_m)  # False for NaN
    for row_step, column_step in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        neighbour_m = depth_m[
            np.ix_(
                np.clip(rows + row_step, 0, camera.height - 1),
                np.clip(columns + column_step, 0, camera.width - 1),
            )
        ]
        keep &= ~(neighbour_m > 0) | (np.abs(neighbour_m - z) <= max_jump * z)
    return _rays(camera, stride)[keep] * z[keep][:, None]


@lru_cache(maxsize=8)
def _rays(camera: Camera, stride: int) -> Floats:
    """Undistorted rays ``(h, w, 3)`` with z = 1 of every ``stride``-th pixel."""
    first = stride // 2
    u, v = np.meshgrid(np.arange(first, camera.width, stride), np.arange(first, camera.height, stride))
    pixels = camera.undistort_points(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
    rays = np.ones((*u.shape, 3))
    rays[..., 0] = ((pixels[:, 0] - camera.cx) / camera.fx).reshape(u.shape)
    rays[..., 1] = ((pixels[:, 1] - camera.cy) / camera.fy).reshape(u.shape)
    rays.setflags(write=False)
    return rays


def checked_cloud(points: Floats, name: str) -> Floats:
    """``points`` as contiguous ``(N, 3)`` float64.

    Raises:
        TrackingError: another shape, or a value that is not finite; says ``name``.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise TrackingError(f"registration: {name} must be (N, 3) metres, got {points.shape}")
    if not np.all(np.isfinite(points)):
        raise TrackingError(f"registration: {name} has points that are not finite; drop unknown depth first")
    return points
