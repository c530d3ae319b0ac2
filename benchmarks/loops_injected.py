# SPDX-License-Identifier: Apache-2.0
"""False loops put into a running tracker: a share of its loop decisions is about another place."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from slamdepth.geometry import invert, rotation_angle_rad, se3_exp
from slamdepth.loops.closer import LoopCloser, Verifier
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import Placement
from slamdepth.tracking import Tracker

_APART_M, _APART_RAD = 1.0, np.deg2rad(30.0)  # a false place is farther away or turned by more than this
_SPREAD = (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)  # metres and radians from the keyframe whose place is claimed
_AGREEING = (40, 200)  # landmarks that agree, as many as in rooms of identical desks


def inject_false_loops(tracker: Tracker, share: float, seed: int) -> FalseLoops:
    """Let ``share`` of the keyframes that look for loops find one with a place that they do not see."""
    first = tracker._active
    return FalseLoops(first.integration.loops, first.map, share, seed)


class FalseLoops:
    """Stands between a loop closer, its place recogniser and its verifier.

    Attributes:
        pairs: ``(earlier, later)`` keyframes of the false loops that were offered.
    """

    def __init__(self, closer: LoopCloser, map_: MapView, share: float, seed: int) -> None:
        self._map, self._share = map_, share
        self._rng = np.random.default_rng([seed, 30])
        self._verifier: Verifier = closer._verifier
        self._query = closer.places.query_keyframe
        self._claimed: int | None = None  # the place that the newest keyframe is said to see
        self.pairs: list[tuple[int, int]] = []
        closer._verifier = self
        setattr(closer.places, "query_keyframe", self._query_keyframe)  # noqa: B010 - mypy refuses a method

    def _query_keyframe(
        self, keyframe_id: int, *, exclude: Collection[int] = (), top_k: int = 10
    ) -> list[tuple[int, float]]:
        answers = self._query(keyframe_id, exclude=exclude, top_k=top_k)
        self._claimed = None
        if self._rng.random() < self._share:
            others = [
                k for k in range(keyframe_id) if k not in exclude and self._is_elsewhere(k, keyframe_id)
            ]
            if others:
                self._claimed = int(self._rng.choice(others))
                self.pairs.append((self._claimed, keyframe_id))
                answers = [(self._claimed, 1.0), *(one for one in answers if one[0] != self._claimed)]
        return answers[:top_k]

    def _is_elsewhere(self, k: int, keyframe_id: int) -> bool:
        D = invert(self._map.keyframes[k].T_world_camera) @ self._map.keyframes[keyframe_id].T_world_camera
        far = float(np.linalg.norm(D[:3, 3])) > _APART_M
        return far or float(rotation_angle_rad(D[:3, :3])) > _APART_RAD

    def from_keyframe(
        self, features: Any, keyframe_id: int, *, minimum: int | None = None
    ) -> Placement | None:
        """The false placement where it is this one's turn, else what the verifier says."""
        if keyframe_id != self._claimed:
            return self._verifier.from_keyframe(features, keyframe_id, minimum=minimum)
        keyframe = self._map.keyframes[keyframe_id]
        seen = keyframe.landmark_ids[keyframe.landmark_ids >= 0]
        count = min(int(self._rng.integers(*_AGREEING)), len(seen), len(features))
        ids = np.full(len(features), -1, dtype=np.int64)
        at = self._rng.choice(len(features), count, replace=False)
        ids[at] = self._rng.choice(seen, count, replace=False)
        T_camera_world = se3_exp(self._rng.normal(size=6) * _SPREAD) @ keyframe.T_camera_world
        return Placement(T_camera_world, ids, seen)
