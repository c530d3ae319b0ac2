# SPDX-License-Identifier: Apache-2.0
"""An exact world: a ring of points around a camera that turns, and a map that drifts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, so3_exp, transform
from slamdepth.loops.closer import LoopCloser, LoopClosure
from slamdepth.mapping.map import Map
from slamdepth.tracking.localiser import Localiser
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame
from slamdepth.typing import Floats, Ints

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
CONFIG = Config.from_dict({"loops": {"min_gap": 5}})
TURN = 18  # keyframes in a full turn
BLANK = np.zeros((480, 640, 3), np.uint8)


@lru_cache(maxsize=1)
def ring() -> tuple[Floats, NDArray[np.uint8]]:
    """Points ``(N, 3)`` on walls all around, and a descriptor for each."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(2.0, 4.0, 3000)
    X = np.stack([radius * np.sin(angle), rng.uniform(-1.2, 1.2, 3000), radius * np.cos(angle)], axis=1)
    return X, rng.integers(0, 256, (3000, 32), dtype=np.uint8)


def true_pose(k: int) -> Floats:
    """``T_world_camera`` on a small circle, looking outwards."""
    angle = 2 * np.pi * k / TURN
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([0.0, angle, 0.0]))
    T[:3, 3] = 0.4 * np.array([np.sin(angle), 0.1 * np.sin(2 * angle), np.cos(angle) - 1.0])
    return T


def view(T_world_camera: Floats) -> tuple[Ints, Floats, Floats]:
    """Which points of the ring are seen from there, at which pixels ``(N, 2)`` and depths in metres."""
    px, z = project(CAMERA, transform(invert(T_world_camera), ring()[0]))
    seen = np.flatnonzero((z > 0.3) & (px > 5).all(1) & (px[:, 0] < 635) & (px[:, 1] < 475))
    return seen, px[seen], z[seen]


class World:
    """A map grown along the circle with a drift of pose and scale; metric if ``is_sensor``.

    Args:
        turn_drift, shift_drift_m, scale_drift: radians, metres and share of the scale lost each step.
        alone: points are tracked to the next keyframe only, so that each keyframe looks for loops.
        seen_from: keyframes that see, in addition to their own place, another one's furniture as from this
            pose.
        astray: radians by which odometry turns wrongly before a keyframe; before the first of these keyframes
            no point is tracked.
    """

    def __init__(
        self,
        count: int,
        *,
        turn_drift: float = 0.0,
        shift_drift_m: float = 0.0,
        scale_drift: float = 0.0,
        is_sensor: bool,
        alone: bool = False,
        seen_from: dict[int, Floats] | None = None,
        astray: dict[int, float] | None = None,
    ) -> None:
        self.map = Map()
        self.closer = LoopCloser(CAMERA, CONFIG, self.map, Localiser(CAMERA, CONFIG, self.map))
        self._ids: dict[int, int] = {}  # landmarks of the points tracked at present
        self._turn_drift, self._scale_drift, self._is_sensor = turn_drift, scale_drift, is_sensor
        self._shift_drift_m, self._alone, self._seen_from = shift_drift_m, alone, seen_from or {}
        self._astray = astray or {}
        self.closures: list[tuple[int, LoopClosure]] = []
        self._pose = np.eye(4)
        for _ in range(count):
            self.grow()

    def grow(self) -> LoopClosure | None:
        k = len(self.map.keyframes)
        scale = self.map.keyframes[-1].scale * (1.0 + self._scale_drift) if k else 1.0
        if k:
            step = invert(true_pose(k - 1)) @ true_pose(k)
            step[:3, 3] *= scale
            drift = so3_exp(np.array([0.0, self._turn_drift + self._astray.get(k, 0.0), 0.0]))
            step[:3, :3] = step[:3, :3] @ drift
            step[1, 3] += self._shift_drift_m
            self._pose = self.map.keyframes[-1].T_world_camera @ step
        if k == min(self._astray, default=-1):
            self._ids = {}
        descriptors = ring()[1]
        seen, px, z = view(true_pose(k))
        own = np.ones(len(seen), dtype=bool)
        if k in self._seen_from:  # a third is left of the true place, and none of it is tracked
            other, other_px, other_z = view(self._seen_from[k])
            kept = slice(None, None, 3)
            seen, px = np.r_[seen[kept], other], np.concatenate([px[kept], other_px])
            own = np.arange(len(seen)) < len(z[kept])
            z = np.r_[z[kept], other_z]
        n = len(seen)
        features = Features(px, px, np.zeros(n, np.int64), np.ones(n), descriptors[seen])
        ids = np.array(
            [self._ids.get(int(i), -1) if o else -1 for i, o in zip(seen, own, strict=True)], dtype=np.int64
        )
        keyframe = self.map.add_keyframe(Frame(k, float(k), BLANK, CAMERA), features, invert(self._pose), ids)
        prediction = DepthPrediction(
            np.zeros((480, 640), np.float32), DepthKind.METRIC, None, is_sensor=self._is_sensor
        )
        self.map.set_depth(keyframe, prediction, np.log(z * scale), np.full(n, 0.02), scale=scale)
        free = np.flatnonzero(ids < 0)
        position = transform(self._pose, backproject(CAMERA, px[free], z[free] * scale))
        new = self.map.create_landmarks(
            keyframe, free, position, np.tile(1e-4 * np.eye(3), (len(free), 1, 1))
        )
        assert len(new) == len(free)
        seen = seen[own]
        self._track(seen, keyframe.landmark_ids[own])
        closure = self.closer.close(keyframe, self.closer.describe(features))
        if closure is not None:
            self.closures.append((k, closure))
            self._track(seen, keyframe.landmark_ids[own])
        return closure

    def _track(self, seen: Ints, ids: Ints) -> None:
        newest = len(self.map.keyframes) - 1
        anchor = self.map.landmarks.anchor_keyframe
        known = zip(seen.tolist(), ids.tolist(), strict=True)
        self._ids = {i: id_ for i, id_ in known if id_ >= 0 and (not self._alone or anchor[id_] == newest)}

    def position_errors_m(self) -> Floats:
        estimate = self.map.T_world_camera[:, :3, 3]
        truth = np.stack([true_pose(k) for k in range(len(estimate))])[:, :3, 3]
        errors: Floats = np.linalg.norm(estimate - truth, axis=1)
        return errors

    def turn_errors_rad(self) -> Floats:
        estimate = self.map.T_world_camera
        truth = np.stack([true_pose(k) for k in range(len(estimate))])
        return rotation_angle_rad((invert(estimate) @ truth)[:, :3, :3])
