# SPDX-License-Identifier: Apache-2.0
"""Which frames show a keyframe's surface from elsewhere."""

from __future__ import annotations

import numpy as np

from slamdepth.geometry import backproject, transform
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Floats32, Ints

_GRID_PX = 20
_BEST_DEG = 6.0
_LEAST_DEG, _MOST_DEG = 1.0, 25.0
_LEAST_SEEN = 0.3
_TRIED = 240  # candidates looked at, evenly over those near enough
_OTHERWISE_DEG = 60.0  # cameras that look away by more than this see little of the same


def surface_points(depth_m: Floats32, camera: Camera, T_world_camera: Floats) -> Floats:
    """Points ``(N, 3)`` in the world frame of a coarse grid of known pixels."""
    height, width = depth_m.shape
    v, u = np.mgrid[_GRID_PX // 2 : height : _GRID_PX, _GRID_PX // 2 : width : _GRID_PX]
    z = depth_m[v, u].ravel()
    known = z > 0
    px = np.column_stack([u.ravel(), v.ravel()])[known].astype(np.float64)
    return transform(T_world_camera, backproject(camera, px, z[known].astype(np.float64)))


def are_seen(points_w: Floats, camera: Camera, T_world_camera: Floats) -> Bools:
    """Which points ``(N, 3)`` lie in the images of cameras.

    Args:
        T_world_camera: ``(C, 4, 4)``.

    Returns:
        ``(C, N)``.
    """
    R, t = T_world_camera[:, :3, :3], T_world_camera[:, :3, 3]
    local = np.einsum("cji,cnj->cni", R, points_w[None] - t[:, None])
    z = local[..., 2]
    ahead = np.maximum(z, 1e-6)
    x = local[..., 0] / ahead * camera.fx + camera.cx
    y = local[..., 1] / ahead * camera.fy + camera.cy
    inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return np.asarray(inside)


def choose_views(
    points_w: Floats, camera: Camera, T_world_camera: Floats, candidates: Floats, count: int
) -> Ints:
    """The frames that tell most of the depth of a keyframe.

    A view is worth its overlap, and most at some degrees of parallax (Yao et al., "MVSNet", ECCV 2018): less
    tells little, more changes how things look. Views near one that is chosen already tell the same.

    Args:
        points_w: ``(N, 3)`` of the keyframe, see :func:`surface_points`.
        camera: pinhole, of all frames.
        T_world_camera: ``(4, 4)`` of the keyframe.
        candidates: ``(C, 4, 4)`` poses; the keyframe's own has no parallax and is never chosen.
        count: most views to choose.

    Returns:
        Rows of ``candidates``, the best first.
    """
    if len(points_w) == 0 or len(candidates) == 0:
        return np.zeros(0, np.int64)
    centre = T_world_camera[:3, 3]
    rays = points_w - centre
    distance = float(np.median(np.linalg.norm(rays, axis=1)))
    way = np.linalg.norm(candidates[:, :3, 3] - centre, axis=1)
    looks = candidates[:, :3, 2] @ T_world_camera[:3, 2]
    near = np.flatnonzero((way > 0) & (way < distance) & (looks > np.cos(np.deg2rad(_OTHERWISE_DEG))))
    if len(near) > _TRIED:
        near = near[np.round(np.linspace(0, len(near) - 1, _TRIED)).astype(np.int64)]
    worth = _worth(points_w, rays, camera, candidates[near])
    centres = candidates[near, :3, 3]
    chosen: list[int] = []
    novelty = np.ones(len(near))
    while len(chosen) < count:
        value = worth * novelty
        best = int(np.argmax(value)) if len(value) else 0
        if len(value) == 0 or value[best] <= 0:
            break
        chosen.append(best)
        apart = np.linalg.norm(centres - centres[best], axis=1) / (0.5 * way[near])
        novelty *= 1.0 - 0.8 * np.exp(-0.5 * apart**2)
        worth[best] = 0.0
    return near[chosen]


def parallax_rad(points_w: Floats, T_world_camera: Floats, views: Floats) -> float:
    """Root mean square, over views, of the median angle at ``points_w (N, 3)`` between keyframe and view.

    Args:
        T_world_camera: ``(4, 4)`` of the keyframe.
        views: ``(V, 4, 4)``, at least one.
    """
    rays = _directions(points_w, T_world_camera[None])[0]
    others = _directions(points_w, views)
    angle = np.arccos(np.clip(np.einsum("nj,vnj->vn", rays, others), -1.0, 1.0))
    return float(np.sqrt(np.mean(np.median(angle, axis=1) ** 2)))


def _directions(points_w: Floats, T_world_camera: Floats) -> Floats:
    """Unit directions ``(C, N, 3)`` from cameras ``(C, 4, 4)`` to points."""
    way = points_w[None] - T_world_camera[:, None, :3, 3]
    return np.asarray(way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-9))


def _worth(points_w: Floats, rays: Floats, camera: Camera, T_world_camera: Floats) -> Floats:
    inside = are_seen(points_w, camera, T_world_camera)
    share = inside.mean(axis=1)
    other = points_w[None] - T_world_camera[:, None, :3, 3]
    cosine = np.einsum("nj,cnj->cn", rays, other)
    cosine /= np.linalg.norm(rays, axis=1) * np.maximum(np.linalg.norm(other, axis=2), 1e-9)
    worth = np.zeros(len(share))
    for c in np.flatnonzero(share >= _LEAST_SEEN):
        seen = inside[c]
        angle = float(np.rad2deg(np.median(np.arccos(np.clip(cosine[c, seen], -1.0, 1.0)))))
        if _LEAST_DEG <= angle <= _MOST_DEG:
            depth = np.linalg.norm(rays[seen], axis=1)
            nearer = float(np.median(np.log(np.linalg.norm(other[c, seen], axis=1) / depth)))
            worth[c] = share[c] * np.exp(
                -0.5 * (np.log(angle / _BEST_DEG) / 0.6) ** 2 - 0.5 * (nearer / 0.4) ** 2
            )
    return worth
