# SPDX-License-Identifier: Apache-2.0
"""Height of a camera over the floor or the road.

Level surfaces are looked for from the strongest downwards: what lies below the largest plane is searched
again until nothing level is left, and the lowest is the floor (desks and seats lie above it). All tolerances
are relative to the height over the plane, since the scale of the map is what is unknown: a relative error of
depth is the same relative error of the height over the floor that its ray meets.

A hand-held camera moves over one plane of the world. One on a car, a cart or a robot keeps its height while
the road bends, and a map of a road drifts in scale. So its height over the landmarks of a few keyframes at a
time is looked for too, and is taken where no plane of the world explains nearly as many keyframes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamdepth.mapping.floor_points import FloorPoints, dense_points, landmarks, observations
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.robust import robust_deviation
from slamdepth.typing import Floats, Ints

MAX_TILT_DEG = 35.0
_KNOWN_TILT_DEG = 12.0  # gravity estimated from images errs by some degrees
_TILT_SIGMA_DEG = 4.0  # how far, in two cases of three
_LEVEL_TILT_DEG = 3.0  # of one level surface of a place against another
_STRONG = 100  # points of a plane that tells what is level

_TOLERANCE = 0.05  # of the height over the plane
_LOCAL_TOLERANCE = 0.07  # the same of the points of a few keyframes, which are less well known
_BENEATH = 3.0  # tolerances
_TRIALS = 500
_MAX_SAMPLE = 1000  # points that a trial plane is compared with
_MIN_POINTS, _MIN_SHARE = 25, 0.01  # on a plane, of all points below the horizon
_MIN_FLOOR = 0.08  # share of the points below the horizon on a floor; less cannot be told from clutter
_MAX_BENEATH = 0.03  # share of the points below the horizon that may lie beneath a floor
_MAX_BENEATH_ROAD = 0.08  # the same of a few keyframes: mirrored, mismatched
_WELL_SUPPORTED = 0.1  # share of the landmarks below the horizon on a plane that needs no dense depth
_NEIGHBOURS = 2  # keyframes on either side of one whose own height is looked for
_MAX_WINDOWS = 40
_SEES = 12  # points on a plane that a keyframe sees
_KEPT_HEIGHT = 0.12  # robust deviation of the log of a kept height, with the drift of a map of a road
_CLEARER = 2.0  # times as many keyframes, for the floor not to be one plane of the world
_FEWEST = 3  # keyframes
_STEEP = 0.3  # sine of the angle between a path and the horizon, above which it is not along the ground


@dataclass(frozen=True)
class Floor:
    """The floor below a camera.

    Attributes:
        height: of the first camera over it, in metres of the map.
        sigma_log: standard error of the log of the height, from the heights that single keyframes see.
        tilt_deg: between its normal and gravity, or the first camera's y axis where that is not known.
        keyframes: number of keyframes that see it.
        share: share of the points below the horizon that lie on it.
        is_mounted: True where all keyframes have this height, each over the ground around it; False where
            the floor is one plane of the world.
    """

    height: float
    sigma_log: float
    tilt_deg: float
    keyframes: int
    share: float
    is_mounted: bool = False


@dataclass(frozen=True)
class _Plane:
    """``normal @ p = offset``; the unit normal points down."""

    normal: Floats
    offset: float

    def heights(self, centres: Floats) -> Floats:
        """Height ``(N,)`` of cameras ``(N, 3)`` over it."""
        return np.asarray(self.offset - centres @ self.normal)

    def beyond(self, points: FloorPoints) -> Floats:
        """How far each point ``(N,)`` lies beneath it, over its camera's height; infinite below it."""
        height = self.heights(points.centre)
        beneath = points.points @ self.normal - self.offset
        return np.where(height > 0, beneath / np.maximum(height, 1e-12), np.inf)


def find_floor(reconstruction: Reconstruction, *, seed: int = 0) -> Floor | None:
    """The floor below the first camera, or None where nothing level is found there.

    Args:
        reconstruction: a finished map; its gravity is used where it is known.
        seed: of the random trials (RANSAC).
    """
    if not reconstruction.keyframes:
        return None
    gravity_w, max_tilt_deg = reconstruction.gravity_w, _KNOWN_TILT_DEG
    if gravity_w is None:
        first = reconstruction.keyframes[0].T_world_camera
        gravity_w, max_tilt_deg = first[:3, :3] @ np.array([0.0, 1.0, 0.0]), MAX_TILT_DEG
    rng = np.random.default_rng(seed)
    rows, owner = observations(reconstruction)
    sparse = landmarks(reconstruction, rows, owner).below(gravity_w)
    level_w, level_tilt_deg = _level(sparse, gravity_w, max_tilt_deg, rng)
    of_world = _one_plane(sparse, gravity_w, level_w, level_tilt_deg, rng)
    if of_world is None or of_world.share < _WELL_SUPPORTED:
        dense = dense_points(reconstruction, rows, owner, gravity_w, max_tilt_deg)
        if dense is not None:
            both = sparse.joined(dense.below(gravity_w))
            of_world = _one_plane(both, gravity_w, level_w, level_tilt_deg, rng)
    mounted = _mounted(reconstruction, rows, owner, gravity_w)
    if of_world is None or mounted is None:
        return of_world or mounted
    return mounted if mounted.keyframes > _CLEARER * of_world.keyframes else of_world


def _level(
    points: FloorPoints, gravity_w: Floats, max_tilt_deg: float, rng: np.random.Generator
) -> tuple[Floats, float]:
    """What is level by the strongest plane of landmarks, and how far other level planes tilt against it."""
    if len(points) < _STRONG:
        return gravity_w, max_tilt_deg
    plane = _plane(points, points, gravity_w, max_tilt_deg, rng)
    if plane is None or np.count_nonzero(np.abs(plane.beyond(points)) < _TOLERANCE) < _STRONG:
        return gravity_w, max_tilt_deg
    return plane.normal, _LEVEL_TILT_DEG


def _one_plane(
    points: FloorPoints, gravity_w: Floats, level_w: Floats, max_tilt_deg: float, rng: np.random.Generator
) -> Floor | None:
    """The floor as one plane of the world."""
    plane = lowest_level(points, level_w, max_tilt_deg, rng)
    if plane is None:
        return None
    on_plane = np.abs(plane.beyond(points)) < _TOLERANCE
    heights = []
    for number in np.unique(points.owner[on_plane]):
        mine = on_plane & (points.owner == number)
        if np.count_nonzero(mine) >= _SEES:
            heights.append(float(np.median(points.points[mine] @ plane.normal)))
    first = float(plane.heights(points.centres[:1])[0])
    if len(heights) < _FEWEST or first <= 0:
        return None
    share = float(np.mean(on_plane))
    if share < _MIN_FLOOR:
        return None
    spread = float(np.std(heights)) / first / math.sqrt(len(heights))
    return Floor(
        height=first,
        sigma_log=math.hypot(spread, _TOLERANCE / 2),  # what lies on it is told to the tolerance
        tilt_deg=_angle_deg(plane.normal, gravity_w),
        keyframes=len(heights),
        share=share,
    )


def _mounted(reconstruction: Reconstruction, rows: Ints, owner: Ints, gravity_w: Floats) -> Floor | None:
    """The ground below a camera that keeps its height and moves parallel to the ground.

    Gravity and the direction of motion say what is level at each keyframe, so that only the height over the
    landmarks of a few keyframes is left: where the logs of the heights are densest.
    """
    keyframes = reconstruction.keyframes
    centres = np.array([keyframe.T_world_camera[:3, 3] for keyframe in keyframes])
    count = len(keyframes)
    windows = np.unique(np.linspace(0, count - 1, min(count, _MAX_WINDOWS)).astype(int))
    found = []
    for number in windows:
        near = np.abs(owner - number) <= _NEIGHBOURS
        first, last = max(0, number - _NEIGHBOURS), min(count - 1, number + _NEIGHBOURS)
        path = centres[last] - centres[first]
        normal = _across(gravity_w, path)
        if normal is None:
            continue
        some = landmarks(reconstruction, rows[near], owner[near])
        # every point as this keyframe sees it: the road is level around it, not elsewhere
        points = FloorPoints(some.points, np.full(len(some), number), some.centres).below(normal)
        height = _densest((points.points - centres[number]) @ normal)
        if height is not None and np.linalg.norm(path) > height:
            share = float(
                np.mean(np.abs((points.points - centres[number]) @ normal / height - 1) < _TOLERANCE)
            )
            found.append((height, _angle_deg(normal, gravity_w), share))
    if len(found) < max(_FEWEST, len(windows) / 2):
        return None
    heights, tilts, shares = np.array(found).T
    centre = float(np.median(np.log(heights)))
    spread = robust_deviation(np.log(heights), centre)
    if spread > _KEPT_HEIGHT:
        return None
    independent = len(found) / len(windows) * count / (2 * _NEIGHBOURS + 1)  # neighbours share their points
    return Floor(
        height=math.exp(centre),
        sigma_log=math.hypot(spread / math.sqrt(max(1.0, independent)), _TOLERANCE / 2),
        tilt_deg=float(np.median(tilts)),
        keyframes=round(len(found) / len(windows) * count),
        share=float(np.median(shares)),
        is_mounted=True,
    )


def _across(gravity_w: Floats, path: Floats) -> Floats | None:
    """The unit direction across ``path (3,)`` that is nearest to gravity; None where the path is steep."""
    length = float(np.linalg.norm(path))
    if length < 1e-12 or abs(float(gravity_w @ path)) > _STEEP * length:
        return None
    across = gravity_w - (gravity_w @ path) / length**2 * path
    return np.asarray(across / np.linalg.norm(across))


def _densest(heights: Floats) -> float | None:
    """The height ``(N,)`` that most others equal to the tolerance, where little lies beneath it."""
    if len(heights) < _MIN_POINTS:
        return None
    logs = np.sort(np.log(heights))
    low, high = (np.searchsorted(logs, logs + side * _LOCAL_TOLERANCE) for side in (-1, 1))
    best = int(np.argmax(high - low))
    beneath = np.mean(logs > logs[best] + _BENEATH * _LOCAL_TOLERANCE)
    return None if beneath > _MAX_BENEATH_ROAD else math.exp(float(np.median(logs[low[best] : high[best]])))


def lowest_level(
    points: FloorPoints,
    gravity_w: Floats,
    max_tilt_deg: float,
    rng: np.random.Generator,
) -> _Plane | None:
    """The lowest level plane of points below the horizon.

    Args:
        gravity_w: ``(3,)`` unit direction.
        max_tilt_deg: of a plane against it.
    """
    pool = np.ones(len(points), dtype=np.bool_)
    found: _Plane | None = None
    least = max(_MIN_POINTS, _MIN_SHARE * len(points))
    while np.count_nonzero(pool) >= least:
        plane = _plane(points.of(pool), points, gravity_w, max_tilt_deg, rng)
        if plane is None:
            break
        beyond = plane.beyond(points)
        count = int(np.count_nonzero(np.abs(beyond) < _TOLERANCE))
        beneath = beyond > _BENEATH * _TOLERANCE
        if count < least or np.count_nonzero(beneath) >= np.count_nonzero(pool):
            break
        found, pool = plane, beneath
    if found is None or np.count_nonzero(pool) > _MAX_BENEATH * len(points):
        return None
    return found


def _plane(
    some: FloorPoints,
    points: FloorPoints,
    gravity_w: Floats,
    max_tilt_deg: float,
    rng: np.random.Generator,
) -> _Plane | None:
    """The plane that most of ``some`` points lie on (RANSAC), fitted to all ``points`` on it."""
    least_cosine = math.cos(math.radians(max_tilt_deg))
    thin = some
    if len(some) > _MAX_SAMPLE:
        chosen = np.zeros(len(some), dtype=np.bool_)
        chosen[rng.choice(len(some), _MAX_SAMPLE, replace=False)] = True
        thin = some.of(chosen)
    a, b, c = (thin.points[rng.integers(0, len(thin), _TRIALS)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals *= (np.sign(normals @ gravity_w) / np.maximum(length, 1e-12))[:, None]
    keep = (length > 1e-12) & (normals @ gravity_w >= least_cosine)
    normals, offsets = normals[keep], np.sum(normals[keep] * a[keep], axis=1)
    if not len(normals):
        return None
    height = offsets[:, None] - normals @ thin.centre.T
    beyond = normals @ thin.points.T - offsets[:, None]
    count = np.count_nonzero((np.abs(beyond) < _TOLERANCE * height) & (height > 0), axis=1)
    tilt_deg = np.degrees(np.arccos(np.minimum(1.0, normals @ gravity_w)))
    best = int(np.argmax(count * np.exp(-0.5 * (tilt_deg / _TILT_SIGMA_DEG) ** 2)))
    return _fitted(_Plane(normals[best], float(offsets[best])), points, gravity_w, least_cosine)


def _fitted(plane: _Plane, points: FloorPoints, gravity_w: Floats, least_cosine: float) -> _Plane:
    """Least squares of relative distances with Tukey's weights; ``plane`` where the result is not level."""
    for _ in range(10):
        beyond = plane.beyond(points)
        mine = np.abs(beyond) < _TOLERANCE
        if np.count_nonzero(mine) < 3:
            return plane
        weight = (1.0 - (beyond[mine] / _TOLERANCE) ** 2) ** 2 / plane.heights(points.centre[mine]) ** 2
        on_plane = points.points[mine]
        centre = weight @ on_plane / weight.sum()
        axes = np.linalg.svd((on_plane - centre) * np.sqrt(weight)[:, None], full_matrices=False)[2]
        normal = axes[2] * (1.0 if axes[2] @ gravity_w > 0 else -1.0)
        if normal @ gravity_w < least_cosine:
            return plane
        plane = _Plane(normal, float(normal @ centre))
    return plane


def _angle_deg(a: Floats, b: Floats) -> float:
    return math.degrees(math.acos(min(1.0, float(a @ b))))
