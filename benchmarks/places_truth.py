# SPDX-License-Identifier: Apache-2.0
"""Ground truth of place recognition: how much of one frame is visible in another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import backproject, invert, project, transform
from slamdepth.types import Camera
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


SAME, DIFFERENT = 0.3, 0.05
"""Overlap from which two frames show one place, and below which they show two."""

_STEP_PX = 16


def overlaps(
    camera: Camera, depths_m: Sequence[NDArray[np.floating]], T_world_camera: Floats, *, tolerance: float
) -> Floats:
    """Overlap ``(N, N)`` of all pairs of frames, the mean over both directions.

    A pixel of one frame is visible in the other if it projects into the image and nothing is in front of
    it. Where the other frame has no depth, it counts as visible.

    Args:
        depths_m: N images ``(H, W)``, metres along z, 0 = unknown.
        T_world_camera: ``(N, 4, 4)`` true poses.
        tolerance: relative depth by which a point may lie behind the measured surface.
    """
    pinhole = camera.without_distortion()
    rows = np.arange(_STEP_PX // 2, camera.height, _STEP_PX)
    columns = np.arange(_STEP_PX // 2, camera.width, _STEP_PX)
    u, v = (axis.ravel() for axis in np.meshgrid(columns, rows))
    undistorted = camera.undistort_points(np.stack([u, v], axis=1).astype(np.float64))
    clouds = []
    for depth_m, T in zip(depths_m, T_world_camera, strict=True):
        z = depth_m[v, u].astype(np.float64)
        known = z > 0  # False for NaN
        clouds.append(transform(T, backproject(pinhole, undistorted[known], z[known])))
    seen = np.zeros((len(clouds), len(clouds)))
    for b, (depth_m, T) in enumerate(zip(depths_m, T_world_camera, strict=True)):
        T_b_world = invert(T)
        for a, cloud in enumerate(clouds):
            if len(cloud):
                seen[a, b] = _share_seen(pinhole, transform(T_b_world, cloud), depth_m, tolerance)
    overlap: Floats = 0.5 * (seen + seen.T)
    return overlap


def _share_seen(camera: Camera, points_c: Floats, depth_m: NDArray[np.floating], tolerance: float) -> float:
    px, z = project(camera, points_c)
    limit = np.array([camera.width - 1, camera.height - 1])
    inside = np.flatnonzero((z > 0) & ((px >= 0) & (px <= limit)).all(axis=1))
    column, row = np.rint(px[inside]).astype(np.int64).T
    there = depth_m[row, column]
    return float(np.count_nonzero(~(z[inside] > (1.0 + tolerance) * there) | ~(there > 0)) / len(points_c))


def labels(overlap: Floats) -> NDArray[np.int8]:
    """1 for one place, 0 for two, -1 for pairs in between, which are ignored."""
    found = np.full(overlap.shape, -1, dtype=np.int8)
    found[overlap >= SAME] = 1
    found[overlap < DIFFERENT] = 0
    return found
