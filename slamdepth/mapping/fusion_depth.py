# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a keyframe's depth are fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import backproject, invert, project, transform
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.types import Camera
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray


JUMP = 0.07
"""Relative depth step between direct neighbours that marks both as flying pixels: on a surface
seen with a 500 px focal length it would take an inclination of 88 degrees."""

_SIGMA_SHARE = 0.75
_SIGMA_SURE = 0.15
_SIGMA_UNSURE = 0.6
_TOLERANCE = 0.10
_VIEW_WIDTH_PX = 160
_MIN_OVERLAP = 0.35
_MAX_NEIGHBOURS = 8


def trusted_depth(keyframe: Keyframe, max_depth_m: float) -> Floats32:
    """Depth ``(H, W)`` in metres, in the raw pixels of ``keyframe``, with unreliable pixels set to 0.

    Dropped are depths beyond ``max_depth_m``, flying pixels at depth jumps and, of predicted depth, the
    quarter with the largest ``sigma_log`` (never one below 0.15, always one above 0.6).
    """
    prediction = keyframe.prediction.load()
    depth_m = keyframe.in_metres(prediction)
    depth = np.where(np.isfinite(depth_m), depth_m, np.float32(0.0)).astype(np.float32)
    drop = (depth <= 0.0) | (depth > max_depth_m) | at_jumps(depth)
    sigma_log = None if prediction.is_sensor else prediction.sigma_log
    if sigma_log is not None:
        sigma = np.where(np.isfinite(sigma_log), sigma_log, np.inf)
        valid = sigma[~drop]
        if len(valid):
            limit = np.clip(np.quantile(valid, _SIGMA_SHARE), _SIGMA_SURE, _SIGMA_UNSURE)
            drop |= sigma > limit
    depth[drop] = 0.0
    return depth


def at_jumps(depth: Floats32) -> NDArray[np.bool_]:
    """Mask of the pixels of depth ``(H, W)`` next to a jump, which sensors and networks smear."""
    jump = np.zeros(depth.shape, bool)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        near = np.minimum(depth[a], depth[b])
        step = (np.abs(depth[a] - depth[b]) > JUMP * near) & (near > 0)
        jump[a] |= step
        jump[b] |= step
    return jump


@dataclass(frozen=True)
class View:
    """A keyframe's depth, undistorted and subsampled, for comparison with other keyframes.

    Attributes:
        camera: undistorted, of the size of ``depth_m``.
        depth_m: ``(h, w)`` float32, 0 = unknown.
        T_world_camera: ``(4, 4)``.
    """

    camera: Camera
    depth_m: Floats32
    T_world_camera: NDArray[np.float64]

    @classmethod
    def of(cls, depth_m: Floats32, camera: Camera, T_world_camera: NDArray[np.float64]) -> View:
        """Subsample undistorted depth ``(H, W)`` by nearest neighbour."""
        step = max(1, camera.width // _VIEW_WIDTH_PX)
        thin = np.ascontiguousarray(depth_m[step // 2 :: step, step // 2 :: step])
        first = step // 2
        height, width = thin.shape
        small = Camera(
            width, height, camera.fx / step, camera.fy / step,
            (camera.cx - first) / step, (camera.cy - first) / step,
        )  # fmt: skip
        return cls(small, thin, T_world_camera)

    def points_world(self, step: int = 1) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Points ``(N, 3)`` of the known pixels and their flat indices ``(N,)``."""
        mask = np.zeros(self.depth_m.shape, bool)
        mask[step // 2 :: step, step // 2 :: step] = True
        index = np.flatnonzero(mask & (self.depth_m > 0))
        v, u = np.divmod(index, self.camera.width)
        points_px = np.stack([u, v], axis=1).astype(np.float64)
        points = backproject(self.camera, points_px, self.depth_m.ravel()[index].astype(np.float64))
        return transform(self.T_world_camera, points), index

    def seen(
        self, points_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.bool_]]:
        """Project points ``(N, 3)`` into this view.

        Returns:
            Their depth ``(N,)``, the depth ``(N,)`` found at their pixels, and a mask ``(N,)`` where both
            exist.
        """
        pixels, z = project(self.camera, transform(invert(self.T_world_camera), points_world))
        column, row = np.round(np.clip(pixels, -1e6, 1e6)).astype(np.int64).T
        known = (
            (z > 0) & (column >= 0) & (column < self.camera.width) & (row >= 0) & (row < self.camera.height)
        )
        found = np.zeros(len(z), np.float32)
        found[known] = self.depth_m[row[known], column[known]]
        return z, found, known & (found > 0)


def consistent_pixels(views: Sequence[View]) -> list[NDArray[np.bool_]]:
    """For each view a mask ``(h, w)`` of the pixels that overlapping views confirm or do not contradict.

    Each pixel's point is projected into up to eight other views. A view that measures the same depth to
    10 % counts +1, one that sees through the point -1, and one that sees something nearer -0.5, because
    that may be an occlusion. Pixels with a sum of -1 or less are dropped.
    """
    overlap = _overlaps(views)
    keep = []
    for i, view in enumerate(views):
        points, index = view.points_world()
        score = np.zeros(len(points), np.float32)
        for j in _neighbours(overlap[i]):
            z, found, known = views[j].seen(points)
            ratio = found / np.maximum(z, 1e-9)
            score += known & (np.abs(ratio - 1.0) <= _TOLERANCE)
            score -= known & (ratio > 1.0 + _TOLERANCE)
            score -= np.float32(0.5) * (known & (ratio < 1.0 - _TOLERANCE))
        mask = np.ones(view.depth_m.size, bool)
        mask[index[score <= -1.0]] = False
        keep.append(mask.reshape(view.depth_m.shape))
    return keep


def _overlaps(views: Sequence[View]) -> NDArray[np.float64]:
    """Share ``(N, N)`` of the points of view i that project to a known pixel of view j."""
    share = np.zeros((len(views), len(views)))
    for i, view in enumerate(views):
        points, _ = view.points_world(step=12)
        if len(points) == 0:
            continue
        for j, other in enumerate(views):
            if i != j:
                share[i, j] = other.seen(points)[2].mean()
    return share


def _neighbours(overlap: NDArray[np.float64]) -> NDArray[np.int64]:
    """Overlapping views, spread from the most to the least overlap: views alike share a network's errors."""
    order = np.argsort(-overlap, kind="stable")
    order = order[overlap[order] >= _MIN_OVERLAP]
    if len(order) <= _MAX_NEIGHBOURS:
        return order
    return order[np.round(np.linspace(0, len(order) - 1, _MAX_NEIGHBOURS)).astype(np.int64)]
