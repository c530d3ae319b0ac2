# SPDX-License-Identifier: Apache-2.0
"""What may be asked of a map; nothing here changes it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from slamdepth.geometry import transform
from slamdepth.mapping.landmarks import Landmarks
from slamdepth.mapping.map_keyframe import KeyframeState, MapKeyframe, read_only
from slamdepth.mapping.sight_index import SightIndex
from slamdepth.typing import Floats, Ints

NEAREST_M = 0.05
"""Landmarks nearer to a camera, or behind it, are not seen by it."""

_INITIAL_CAPACITY = 4096
_DOUBTED_SHARE = 0.05  # of keyframes without a known scale; of images like the training's, 1 in 200 has none


def median_depth_m(T_camera_world: Floats, points_w: Floats) -> float:
    """Median depth of points ``(N, 3)``, at least one, seen by a camera ``(4, 4)``; at least 0.05 m."""
    depths = np.sort(points_w @ T_camera_world[2, :3] + T_camera_world[2, 3])
    return max(float(depths[len(depths) // 2]), NEAREST_M)


class MapView:
    """The read-only part of a :class:`~slamdepth.mapping.map.Map`.

    Attributes:
        landmarks: arrays of all landmarks, living or not, that cannot be written.
        keyframes: in order of time, but for those of maps taken over; a keyframe's id is its index.
        starts: ids of the keyframes that no odometry leads to: the first one of each map in this map.
    """

    def __init__(self) -> None:
        self._states: list[KeyframeState] = []
        self._sights = SightIndex()
        self._own = Landmarks.empty(_INITIAL_CAPACITY)
        self.landmarks: Landmarks = self._own.read_only(0)
        self.keyframes: tuple[MapKeyframe, ...] = ()
        self.starts: frozenset[int] = frozenset({0})

    @property
    def size(self) -> int:
        """Number of landmark ids in use, of living and of dead landmarks."""
        return len(self.landmarks)

    @property
    def is_measured(self) -> bool:
        """Whether depth is a sensor's, so that the map is metric and its scale cannot drift."""
        prediction = self._states[0].prediction
        return prediction is not None and prediction.is_sensor

    @property
    def scale_is_doubted(self) -> bool:
        """Whether the model says of too many keyframes that nothing supports the scale of their depth.

        The other keyframes of the same place are hardly more like what the model knows.
        """
        unknown = sum(
            state.prediction is not None and state.prediction.scale_sigma_log == math.inf
            for state in self._states
        )
        return unknown > _DOUBTED_SHARE * len(self._states)

    @property
    def T_world_camera(self) -> Floats:
        """Poses ``(K, 4, 4)`` of the keyframes."""
        return read_only(np.stack([keyframe.T_world_camera for keyframe in self.keyframes]))

    @property
    def units(self) -> Floats:
        """``(K,)`` see :attr:`MapKeyframe.unit`."""
        return read_only(np.array([state.unit for state in self._states]))

    def resolve(self, ids: Ints) -> Ints:
        """Landmarks that ``ids`` (any shape) were fused into; -1 where they are gone."""
        alias, alive = self.landmarks.alias, self.landmarks.alive
        out: Ints = np.array(ids)
        known = ids >= 0
        target = alias[ids[known]]
        while not np.array_equal(further := alias[target], target):
            target = further
        out[known] = np.where(alive[target], target, -1)
        return out

    def shared_landmarks(self, ids: Ints) -> Ints:
        """How many of the landmarks ``ids`` each keyframe sees, ``(K,)``; -1 counts for none."""
        mask = self.mask(ids)
        shared = np.zeros(len(self._states), dtype=np.int64)
        for k in self._sights.candidates(mask):
            shared[k] = np.count_nonzero(mask[self._states[k].landmark_ids])
        return shared

    def shared_with_next(self) -> Ints:
        """How many landmarks each keyframe but the last shares with the next one, ``(K - 1,)``."""
        seen_last = np.full(self.size + 1, -1)
        shared = np.zeros(max(len(self._states) - 1, 0), dtype=np.int64)
        for k, (a, b) in enumerate(pairwise(self._states)):
            seen_last[a.landmark_ids] = k
            seen_last[-1] = -1
            shared[k] = np.count_nonzero(seen_last[b.landmark_ids] == k)
        return shared

    def covisibility(self) -> Ints:
        """How many landmarks each two keyframes share, ``(K, K)``; on the diagonal how many each sees."""
        from scipy.sparse import csr_matrix

        seen = [state.landmark_ids[state.landmark_ids >= 0] for state in self._states]
        ends = np.concatenate([[0], np.cumsum([len(ids) for ids in seen])])
        columns = np.concatenate(seen)
        sees = csr_matrix((np.ones(len(columns), np.int64), columns, ends), shape=(len(seen), self.size))
        return np.asarray((sees @ sees.T).toarray())

    def times_seen(self, ids: Ints, before: int) -> Ints:
        """How many of the first ``before`` keyframes see each of the landmarks ``ids``, ``(N,)``."""
        times = np.zeros(self.size + 1, dtype=np.int64)
        for k in self._sights.candidates(self.mask(ids)):
            if k < before:
                times[self._states[k].landmark_ids] += 1
        return times[ids]

    def covisible(self, ids: Ints, limit: int, minimum: int = 1) -> list[int]:
        """Up to ``limit`` keyframes that see most of ``ids``, best first, each ``minimum`` or more."""
        shared = self.shared_landmarks(ids)
        order = np.argsort(-shared, kind="stable")[:limit]
        return [int(k) for k in order if shared[k] >= minimum]

    def seen_from(self, keyframe_ids: Sequence[int]) -> Ints:
        """Ids of the living landmarks that any of these keyframes sees, ascending."""
        mask = np.zeros(self.size + 1, dtype=bool)
        for k in keyframe_ids:
            mask[self._states[k].landmark_ids] = True
        return np.flatnonzero(mask[:-1] & self.landmarks.alive)

    def seen_by(self, keyframes: int) -> Ints:
        """Ids of the living landmarks that at least so many keyframes see, ascending."""
        return np.flatnonzero(self.landmarks.alive & (self.landmarks.observations >= keyframes))

    def depths_seen(self, keyframe: MapKeyframe, observations: int) -> tuple[Ints, Ints, Floats]:
        """Landmarks in front of ``keyframe`` that it and others see.

        Args:
            observations: keyframes that must see a landmark, itself included.

        Returns:
            ``(features, landmark ids, depths in metres)``, ``(N,)`` each.
        """
        at = np.flatnonzero(keyframe.landmark_ids >= 0)
        at = at[self.landmarks.observations[keyframe.landmark_ids[at]] >= observations]
        ids = keyframe.landmark_ids[at]
        z = transform(keyframe.T_camera_world, self.landmarks.position_w[ids])[:, 2]
        ok = z > NEAREST_M
        return at[ok], ids[ok], z[ok]

    def sigma_along_ray(self, ids: Ints, center_w: Floats) -> Floats:
        """Relative deviation ``(N,)`` of the distance of landmarks from a camera centre ``(3,)``."""
        offset = self.landmarks.position_w[ids] - center_w
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
        ray = offset / distance[:, None]
        variance = np.einsum("ni,nij,nj->n", ray, self.landmarks.covariance_w[ids], ray)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)) / distance)

    def mask(self, ids: Ints) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """``(size + 1,)`` True at ``ids``; the last entry, which -1 indexes, is False."""
        mask = np.zeros(self.size + 1, dtype=np.bool_)
        mask[ids] = True
        mask[-1] = False
        return mask
