# SPDX-License-Identifier: Apache-2.0
"""Height of the first camera over the floor, from the depth of the keyframes.

The floor is a plane below the first camera whose normal is close to gravity, where that is known. Where it
is not, the first camera is assumed to be upright to within ``MAX_TILT_DEG``. Of several such planes (seats,
desks, the floor) the lowest is taken that is large and has almost no points below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.fusion_depth import View, trusted_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.tsdf import undistorted_depth
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


MAX_TILT_DEG = 35.0
_KNOWN_TILT_DEG = 20.0  # predicted floors lean, and gravity estimated from images errs by some degrees

_MAX_KEYFRAMES = 40
_STEP = 2  # of a view 160 pixels wide
_NORMAL_TOLERANCE_DEG = 15.0  # a surface of predicted depth is wavy
_TOLERANCE = 0.02  # of the median distance of points from the first camera
_TRIALS = 500
_PLANES = 4
_MIN_SHARE, _MIN_LEVEL_SHARE = 0.02, 0.1  # of all points, of the level ones, that a floor has at least
_MIN_POINTS = 200
_MAX_BENEATH = 0.03  # share of all points that may lie clearly below a floor
_MIN_HEIGHT = 0.1  # of the median distance: nearer is the camera's support or a hand


@dataclass(frozen=True)
class Floor:
    """A plane below the first camera: ``normal @ p = height`` for points in the world.

    Attributes:
        normal: ``(3,)`` unit vector along gravity.
        height: height of the first camera over it, in metres of the map.
        sigma_log: standard error of the log of the height, from the spread of the heights that single
            keyframes see.
        tilt_deg: between the normal and gravity, or the first camera's y axis where that is not known.
        keyframes: number of keyframes that see it.
        share: share of all points that lie on it.
    """

    normal: Floats
    height: float
    sigma_log: float
    tilt_deg: float
    keyframes: int
    share: float


@dataclass(frozen=True)
class _Upright:
    """The planes that may be a floor."""

    gravity_w: Floats
    least_cosine: float
    min_height: float

    def plane(self, normal: Floats, point: Floats) -> tuple[Floats, float] | None:
        """Unit normal (along gravity) and height of the plane, None where it cannot be a floor."""
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            return None
        cosine = float(normal @ self.gravity_w) / length
        normal = normal / length * (1.0 if cosine > 0 else -1.0)
        height = float(normal @ point)
        return None if abs(cosine) < self.least_cosine or height < self.min_height else (normal, height)


def find_floor(
    keyframes: Sequence[Keyframe], max_depth_m: float, *, gravity_w: Floats | None = None, seed: int = 0
) -> Floor | None:
    """The floor below the first camera, or None where no large level surface is found there.

    Args:
        keyframes: in order of time; the world is the first camera.
        max_depth_m: depth beyond is not used.
        gravity_w: unit direction of gravity ``(3,)`` in the world; None where it is not known.
        seed: of the random trials (RANSAC).
    """
    max_tilt_deg = MAX_TILT_DEG if gravity_w is None else _KNOWN_TILT_DEG
    gravity_w = np.array([0.0, 1.0, 0.0]) if gravity_w is None else gravity_w
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, min(len(keyframes), _MAX_KEYFRAMES)).astype(int))
    clouds = [_points_and_normals(keyframes[i], max_depth_m) for i in chosen]
    if not clouds or not (total := sum(len(points) for points, _ in clouds)):
        return None
    points = np.concatenate([points for points, _ in clouds])
    normals = np.concatenate([normals for _, normals in clouds])
    owner = np.repeat(np.arange(len(clouds)), [len(points) for points, _ in clouds])
    scale = float(np.median(np.linalg.norm(points, axis=1)))
    tolerance = _TOLERANCE * scale
    level = np.abs(normals @ gravity_w) > math.cos(math.radians(max_tilt_deg + _NORMAL_TOLERANCE_DEG))
    upright = _Upright(gravity_w, math.cos(math.radians(max_tilt_deg)), _MIN_HEIGHT * scale)
    rng = np.random.default_rng(seed)
    left = level.copy()
    best: tuple[float, Floats, NDArray[np.bool_]] | None = None
    for _ in range(_PLANES):
        found = _plane(points[left], normals[left], tolerance, upright, rng)
        if found is None:
            break
        normal, height = found
        on_plane = level & _lies_on(points, normals, normal, height, tolerance)
        left &= ~on_plane
        least = max(_MIN_POINTS, _MIN_SHARE * total, _MIN_LEVEL_SHARE * np.count_nonzero(level))
        if np.count_nonzero(on_plane) < least:
            continue
        beneath = np.mean(points @ normal > height + 4 * tolerance)
        if beneath <= _MAX_BENEATH and (best is None or height > best[0]):
            best = height, normal, on_plane
    if best is None:
        return None
    height, normal, on_plane = best
    heights = [
        float(np.median(points[mine] @ normal))
        for k in range(len(clouds))
        if np.count_nonzero(mine := on_plane & (owner == k)) >= _MIN_POINTS // 4
    ]
    # at least the tolerance: the heights of few keyframes may agree by chance
    spread = max(float(np.std(heights)) if len(heights) > 1 else 0.0, tolerance)
    return Floor(
        normal=normal,
        height=height,
        sigma_log=spread / height / math.sqrt(max(1, len(heights))),
        tilt_deg=math.degrees(math.acos(min(1.0, float(normal @ gravity_w)))),
        keyframes=len(heights),
        share=float(np.mean(on_plane)),
    )


def _points_and_normals(keyframe: Keyframe, max_depth_m: float) -> tuple[Floats, Floats]:
    """Surface points ``(N, 3)`` in the world and their unit normals, of either sign."""
    camera = keyframe.frame.camera
    depth_m = undistorted_depth(trusted_depth(keyframe, max_depth_m), camera)
    view = View.of(depth_m, camera.without_distortion(), keyframe.T_world_camera)
    inside = view.depth_m[_STEP:-_STEP, _STEP:-_STEP] > 0
    grid = np.full((*view.depth_m.shape, 3), np.nan)
    points, index = view.points_world()
    grid.reshape(-1, 3)[index] = points
    across = grid[_STEP:-_STEP, 2 * _STEP :] - grid[_STEP:-_STEP, : -2 * _STEP]
    down = grid[2 * _STEP :, _STEP:-_STEP] - grid[: -2 * _STEP, _STEP:-_STEP]
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=2)
    keep = inside & (length > 0)  # False for NaN
    keep[1::2] = False
    keep[:, 1::2] = False
    return grid[_STEP:-_STEP, _STEP:-_STEP][keep], normals[keep] / length[keep][:, None]


def _plane(
    points: Floats, normals: Floats, tolerance: float, upright: _Upright, rng: np.random.Generator
) -> tuple[Floats, float] | None:
    """The level plane below the world's origin that most points lie on (RANSAC, then least squares)."""
    if len(points) < _MIN_POINTS:
        return None
    thin = slice(None, None, max(1, len(points) // 3000))
    some, some_normals = points[thin], normals[thin]
    best, most = None, 0
    for three in rng.integers(0, len(some), (_TRIALS, 3)):
        a, b, c = some[three]
        found = upright.plane(np.cross(b - a, c - a), a)
        if found is None:
            continue
        count = int(np.count_nonzero(_lies_on(some, some_normals, *found, tolerance)))
        if count > most:
            best, most = found, count
    if best is None:
        return None
    for _ in range(5):
        mine = points[_lies_on(points, normals, *best, tolerance)]
        if len(mine) < 3:
            return None
        centre = mine.mean(axis=0)
        axes = np.linalg.svd(mine - centre, full_matrices=False)[2]
        better = upright.plane(axes[2], centre)
        if better is None:
            return None
        best = better
    return best


def _lies_on(
    points: Floats, normals: Floats, normal: Floats, height: float, tolerance: float
) -> NDArray[np.bool_]:
    near = np.abs(points @ normal - height) < tolerance
    return near & (np.abs(normals @ normal) > math.cos(math.radians(2 * _NORMAL_TOLERANCE_DEG)))
