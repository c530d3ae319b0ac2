# SPDX-License-Identifier: Apache-2.0
"""Points that a floor is looked for in: triangulated landmarks, and dense depth where it agrees with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamdepth.geometry import invert, project, transform
from slamdepth.mapping.fusion_depth import View, trusted_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.undistorted import undistorted_depth
from slamdepth.robust import robust_deviation
from slamdepth.typing import Bools, Floats, Floats32, Ints

_MIN_PARALLAX_RAD = math.radians(2.0)
"""Angle between the rays of a triangulated landmark: with a pixel of error at 500 px of focal length its
depth errs by 6 %."""
_STEEP = 0.08  # sine of the angle below the horizon, under which a ray grazes a floor
_AGREES = 0.06  # robust deviation of log depth from landmarks, below which dense depth is used
_FEWEST_JUDGES = 50
_MAX_KEYFRAMES = 40
_STEP = 2  # of a view 160 pixels wide
_WAVY_DEG = 15.0  # between the normals of a surface of predicted depth


@dataclass(frozen=True)
class FloorPoints:
    """Points, each with the camera that sees it.

    Attributes:
        points: ``(N, 3)`` world, metres of the map.
        owner: ``(N,)`` number of a keyframe that sees it, the nearest.
        centres: ``(K, 3)`` of all keyframes.
    """

    points: Floats
    owner: Ints
    centres: Floats

    def __len__(self) -> int:
        return len(self.points)

    @property
    def centre(self) -> Floats:
        """Centre ``(N, 3)`` of the camera that sees each point."""
        return self.centres[self.owner]

    def of(self, mask: Bools) -> FloorPoints:
        """Those points of a mask ``(N,)``."""
        return FloorPoints(self.points[mask], self.owner[mask], self.centres)

    def below(self, gravity_w: Floats) -> FloorPoints:
        """Those clearly below the horizon of the camera that sees them."""
        ray = self.points - self.centre
        return self.of(ray @ gravity_w > _STEEP * np.linalg.norm(ray, axis=1))

    def joined(self, other: FloorPoints) -> FloorPoints:
        """These points and those of ``other``, of the same keyframes."""
        return FloorPoints(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.owner, other.owner]),
            self.centres,
        )


def observations(reconstruction: Reconstruction) -> tuple[Ints, Ints]:
    """Rows ``(M,)`` of triangulated landmarks and the numbers ``(M,)`` of the keyframes that see them."""
    keyframes, points = reconstruction.keyframes, reconstruction.points_m
    seen = [k.point_rows[k.point_rows >= 0] for k in keyframes]
    rows = np.concatenate([*seen, np.zeros(0, np.int64)])
    owner = np.repeat(np.arange(len(keyframes)), [len(some) for some in seen])
    if not len(rows):
        return rows, owner
    ray = points[rows] - _centres(reconstruction)[owner]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    mean = np.zeros_like(points)
    np.add.at(mean, rows, ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    angle = np.arccos(np.clip(np.sum(ray * mean[rows], axis=1), -1.0, 1.0))
    largest = np.zeros(len(points))
    np.maximum.at(largest, rows, angle)
    wide = 2.0 * largest[rows] >= _MIN_PARALLAX_RAD
    return rows[wide], owner[wide]


def landmarks(reconstruction: Reconstruction, rows: Ints, owner: Ints) -> FloorPoints:
    """Each landmark of :func:`observations` once, seen by the nearest of the keyframes given."""
    points, centres = reconstruction.points_m, _centres(reconstruction)
    distance = np.linalg.norm(points[rows] - centres[owner], axis=1)
    order = np.lexsort((distance, rows))
    first = np.unique(rows[order], return_index=True)[1]
    return FloorPoints(points[rows[order][first]], owner[order][first], centres)


def dense_points(
    reconstruction: Reconstruction, rows: Ints, owner: Ints, gravity_w: Floats, max_tilt_deg: float
) -> FloorPoints | None:
    """Points of the keyframes' depth; None where it disagrees with the landmarks below the horizon.

    Predicted depth may be bent where a network knows nothing alike: on a road it was up to twice too far.
    """
    keyframes, centres = reconstruction.keyframes, _centres(reconstruction)
    if not keyframes:
        return None
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, min(len(keyframes), _MAX_KEYFRAMES)).astype(int))
    least_cosine = math.cos(math.radians(max_tilt_deg + _WAVY_DEG))
    off: list[Floats] = []
    points: list[Floats] = []
    for number in chosen:
        keyframe = keyframes[number]
        depth_m = undistorted_depth(trusted_depth(keyframe, math.inf), keyframe.frame.camera)
        seen = FloorPoints(reconstruction.points_m[rows[owner == number]], owner[owner == number], centres)
        off.append(_log_ratio(keyframe, depth_m, seen.below(gravity_w).points))
        points.append(_level_points(keyframe, depth_m, gravity_w, least_cosine))
    if not all(keyframe.prediction.is_sensor for keyframe in keyframes):
        ratio = np.concatenate(off)
        if len(ratio) < _FEWEST_JUDGES:
            return None
        if robust_deviation(ratio) > _AGREES:
            return None
    counts = [len(some) for some in points]
    return FloorPoints(np.concatenate(points), np.repeat(chosen, counts), centres)


def _centres(reconstruction: Reconstruction) -> Floats:
    places = [keyframe.T_world_camera[:3, 3] for keyframe in reconstruction.keyframes]
    return np.array(places, dtype=np.float64).reshape(-1, 3)


def _log_ratio(keyframe: Keyframe, depth_m: Floats32, points: Floats) -> Floats:
    """Log ratio of the depth of landmarks ``(N, 3)`` to dense, undistorted depth ``(H, W)``, where known."""
    camera = keyframe.frame.camera.without_distortion()
    pixels, z = project(camera, transform(invert(keyframe.T_world_camera), points))
    u, v = np.rint(np.clip(pixels, -1e6, 1e6)).astype(np.int64).T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    there = depth_m[v[inside], u[inside]]
    known = there > 0
    return np.asarray(np.log(z[inside][known]) - np.log(there[known].astype(np.float64)))


def _level_points(keyframe: Keyframe, depth_m: Floats32, gravity_w: Floats, least_cosine: float) -> Floats:
    """Surface points ``(N, 3)`` in the world whose normal is near gravity, every few pixels."""
    camera = keyframe.frame.camera
    view = View.of(depth_m, camera.without_distortion(), keyframe.T_world_camera)
    grid = np.full((*view.depth_m.shape, 3), np.nan)
    points, index = view.points_world()
    grid.reshape(-1, 3)[index] = points
    across = grid[_STEP:-_STEP, 2 * _STEP :] - grid[_STEP:-_STEP, : -2 * _STEP]
    down = grid[2 * _STEP :, _STEP:-_STEP] - grid[: -2 * _STEP, _STEP:-_STEP]
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        level = np.abs(normals @ gravity_w) / length > least_cosine  # False for NaN
    level[1::_STEP], level[:, 1::_STEP] = False, False
    return np.asarray(grid[_STEP:-_STEP, _STEP:-_STEP][level])
