# SPDX-License-Identifier: Apache-2.0
"""The sparse map while it grows: points in arrays, keyframes in a list.

Points live in growing arrays and are named by their row, so that everything done to
them is done to whole arrays. A point that dies keeps its row, and one merged into another
points there through ``alias``, until :meth:`LandmarkMap.compact` gives the rows away.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.geometry import invert, transform
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass
class MapKeyframe:
    """A keyframe while the map is being built; poses and point ids change.

    Attributes:
        features: see ``slamdepth.frontend.features.Features``.
        T_camera_world: ``(4, 4)``.
        point_ids: ``(N,)`` row of the map point each keypoint sees, -1 for none.
        log_depth, sigma_log: ``(N,)`` depth prior of each keypoint in metres of the
            map, NaN where it has none.
        predicted_log_depth: ``(N,)`` what a network said of each keypoint, NaN where nothing.
        velocity: ``(6,)`` m/s and rad/s in the camera's own axes when it was taken.
    """

    id: int
    frame: StoredFrame
    features: Any
    T_camera_world: Floats
    point_ids: Ints
    log_depth: Floats
    sigma_log: Floats
    prediction: StoredPrediction | None = None
    predicted_log_depth: Floats = field(default_factory=lambda: np.zeros(0))
    scale: float = 1.0
    velocity: Floats = field(default_factory=lambda: np.zeros(6))

    @property
    def center_w(self) -> Floats:
        """Camera centre ``(3,)`` in the world."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    @property
    def T_world_camera(self) -> Floats:
        return invert(self.T_camera_world)


_LEAST_ROWS = 4096
NEAREST_M = 0.05
"""What is nearer to a camera, or behind it, is not seen by it."""


class LandmarkMap:
    """Map points and the keyframes that see them."""

    def __init__(self) -> None:
        self.keyframes: list[MapKeyframe] = []
        self.size = 0
        self._compact_at = _LEAST_ROWS
        self.descriptor = np.zeros((0, 0), np.uint8)
        self._move(np.zeros(0, dtype=np.int64), _LEAST_ROWS)

    def _move(self, kept: Ints, capacity: int) -> None:
        """Make room for ``capacity`` points, with the rows ``kept`` as the first ones."""

        def move(name: str, shape: tuple[int, ...], dtype: Any) -> None:
            array = np.zeros((capacity, *shape), dtype=dtype)
            if len(kept):
                array[: len(kept)] = getattr(self, name)[kept]
            setattr(self, name, array)

        move("position_w", (3,), np.float64)
        move("covariance_w", (3, 3), np.float64)
        move("descriptor", self.descriptor.shape[1:], self.descriptor.dtype)
        move("birth_keyframe", (), np.int64)
        move("octave", (), np.int64)
        move("distance_m", (), np.float64)
        move("direction_w", (3,), np.float64)
        move("visible", (), np.int64)
        move("found", (), np.int64)
        move("observations", (), np.int64)
        move("alive", (), np.bool_)
        move("alias", (), np.int64)

    position_w: Floats
    covariance_w: Floats
    descriptor: NDArray[Any]
    birth_keyframe: Ints
    octave: Ints
    distance_m: Floats
    direction_w: Floats
    visible: Ints
    found: Ints
    observations: Ints
    alive: Bools
    alias: Ints

    @property
    def is_measured(self) -> bool:
        """Whether depth is a sensor's, so that the map is metric and its scale cannot drift."""
        prediction = self.keyframes[0].prediction
        return prediction is not None and prediction.is_sensor

    def add_points(
        self, keyframe: MapKeyframe, feature: Ints, position_w: Floats, covariance_w: Floats
    ) -> Ints:
        """Give birth to points seen by ``keyframe`` at its keypoints ``feature``; returns their rows."""
        n = len(feature)
        while self.size + n > len(self.alive):
            self._move(np.arange(self.size), 2 * len(self.alive))
        if self.size == 0:  # the first points tell what a descriptor is
            kind = keyframe.features.descriptors
            self.descriptor = np.zeros((len(self.alive), *kind.shape[1:]), kind.dtype)
        rows = np.arange(self.size, self.size + n)
        self.size += n
        self.position_w[rows] = position_w
        self.covariance_w[rows] = covariance_w
        self.descriptor[rows] = keyframe.features.descriptors[feature]
        self.birth_keyframe[rows] = keyframe.id
        self.octave[rows] = keyframe.features.octave[feature]
        offset = position_w - keyframe.center_w
        distance = np.linalg.norm(offset, axis=1)
        self.distance_m[rows] = distance
        self.direction_w[rows] = offset / np.maximum(distance, 1e-9)[:, None]
        self.visible[rows] = 1
        self.found[rows] = 1
        self.observations[rows] = 1
        self.alive[rows] = True
        self.alias[rows] = rows
        keyframe.point_ids[feature] = rows
        return rows

    def add_keyframe(self, keyframe: MapKeyframe) -> None:
        self.keyframes.append(keyframe)
        self.observations[keyframe.point_ids[keyframe.point_ids >= 0]] += 1

    def refresh_views(self, rows: Ints) -> None:
        """Recompute from where, and from how far, points were first seen, after anything moved."""
        centers = np.stack([k.center_w for k in self.keyframes])
        offset = self.position_w[rows] - centers[self.birth_keyframe[rows]]
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        self.distance_m[rows] = distance
        self.direction_w[rows] = offset / distance[:, None]

    def compact(self) -> Ints | None:
        """Give away the rows of points that are gone, each time there are twice as many as after
        the last time; the order of the others stays.

        Returns:
            What each row is now, -1 where its point is gone, and a last -1 for "none",
            ``(size + 1,)``: whoever remembers rows must look them up. None where nothing changed.
        """
        n = self.size
        if n < self._compact_at:
            return None
        is_kept = np.append(self.alive[:n], False)
        for keyframe in self.keyframes:
            is_kept[keyframe.point_ids] = True
        is_kept[-1] = False
        kept = np.flatnonzero(is_kept)
        now = np.full(n + 1, -1, dtype=np.int64)
        now[kept] = np.arange(len(kept))
        merged_into = self.resolve(np.arange(n))
        now[:n] = np.where(is_kept[:n], now[:n], now[merged_into])
        self.alias[:n] = np.where(merged_into >= 0, merged_into, np.arange(n))
        self.size = len(kept)
        self._compact_at = max(_LEAST_ROWS, 2 * self.size)
        self._move(kept, self._compact_at)
        self.alias[: self.size] = now[self.alias[: self.size]]
        for keyframe in self.keyframes:
            keyframe.point_ids = now[keyframe.point_ids]
        return now

    def resolve(self, rows: Ints) -> Ints:
        """Rows after merges and deaths: -1 where the point is gone."""
        out = rows.copy()
        known = rows >= 0
        target = self.alias[rows[known]]
        while not np.array_equal(further := self.alias[target], target):
            target = further
        out[known] = np.where(self.alive[target], target, -1)
        return out

    def merge(self, losers: Ints, winners: Ints) -> None:
        """Let each of ``winners`` take over what the point ``losers`` at the same place was seen by.

        A point occurs on one side only; several losers may share a winner. A keyframe that
        sees both keeps the winner's keypoint.
        """
        if len(losers) == 0:
            return
        target = np.arange(self.size)
        target[losers] = winners
        is_loser = np.zeros(self.size + 1, dtype=bool)
        is_loser[losers] = True  # and never the last, which stands for -1
        for keyframe in self.keyframes:
            ids = keyframe.point_ids
            moved = np.flatnonzero(is_loser[ids])
            if len(moved) == 0:
                continue
            taken = np.zeros(self.size + 1, dtype=bool)
            taken[ids] = True
            winner = target[ids[moved]]
            keeps = np.zeros(len(moved), dtype=bool)
            keeps[np.unique(winner, return_index=True)[1]] = True  # of several the first
            keeps &= ~taken[winner]
            ids[moved] = np.where(keeps, winner, -1)
            self.observations[winner[keeps]] += 1
        self.alive[losers] = False
        self.alias[losers] = winners
        np.add.at(self.visible, winners, self.visible[losers])
        np.add.at(self.found, winners, self.found[losers])

    def kill(self, rows: Ints) -> None:
        """Remove points from the map and from every keyframe."""
        if len(rows) == 0:
            return
        self.alive[rows] = False
        dead = np.zeros(self.size + 1, dtype=bool)
        dead[rows] = True
        for keyframe in self.keyframes:
            keyframe.point_ids[dead[keyframe.point_ids]] = -1

    def drop_observations(self, keyframe_index: Ints, feature: Ints) -> None:
        """Forget single observations; points left with none die."""
        for k in np.unique(keyframe_index):
            keyframe = self.keyframes[k]
            at = feature[keyframe_index == k]
            rows = keyframe.point_ids[at]
            keyframe.point_ids[at] = -1
            np.subtract.at(self.observations, rows[rows >= 0], 1)
        self.alive[: self.size] &= self.observations[: self.size] > 0

    def shared_points(self, rows: Ints) -> Ints:
        """How many of the points ``rows`` each keyframe sees, ``(K,)``."""
        mask = np.zeros(self.size + 1, dtype=bool)
        mask[rows[rows >= 0]] = True
        mask[-1] = False
        return np.array([np.count_nonzero(mask[k.point_ids]) for k in self.keyframes], dtype=np.int64)

    def covisibility(self) -> Ints:
        """How many points each two keyframes share, ``(K, K)``; each with itself: how many it sees."""
        from scipy.sparse import csr_matrix

        seen = [keyframe.point_ids[keyframe.point_ids >= 0] for keyframe in self.keyframes]
        ends = np.concatenate([[0], np.cumsum([len(rows) for rows in seen])])
        columns = np.concatenate(seen)
        sees = csr_matrix((np.ones(len(columns), np.int64), columns, ends), shape=(len(seen), self.size))
        return np.asarray((sees @ sees.T).toarray())

    def times_seen(self, rows: Ints, before: int) -> Ints:
        """By how many of the first ``before`` keyframes each of the points ``rows`` is seen, ``(N,)``."""
        times = np.zeros(self.size + 1, dtype=np.int64)
        for keyframe in self.keyframes[:before]:
            times[keyframe.point_ids] += 1
        return times[rows]

    def covisible(self, rows: Ints, limit: int, minimum: int = 1) -> list[int]:
        """Keyframes that see most of the points ``rows``, best first."""
        shared = self.shared_points(rows)
        order = np.argsort(-shared, kind="stable")[:limit]
        return [int(k) for k in order if shared[k] >= minimum]

    def points_of(self, keyframe_ids: list[int]) -> Ints:
        """Rows of the living points the keyframes see, each once, ascending."""
        mask = np.zeros(self.size + 1, dtype=bool)
        for k in keyframe_ids:
            mask[self.keyframes[k].point_ids] = True
        mask[-1] = False
        return np.flatnonzero(mask[: self.size] & self.alive[: self.size])

    def depths_seen(self, keyframe: MapKeyframe, observations: int) -> tuple[Ints, Ints, Floats]:
        """Features of ``keyframe``, rows and depths in it, of points before it that so many keyframes see."""
        at = np.flatnonzero(keyframe.point_ids >= 0)
        at = at[self.observations[keyframe.point_ids[at]] >= observations]
        rows = keyframe.point_ids[at]
        z = transform(keyframe.T_camera_world, self.position_w[rows])[:, 2]
        ok = z > NEAREST_M
        return at[ok], rows[ok], z[ok]

    def seen_by(self, keyframes: int) -> Ints:
        """Rows of the living points that at least so many keyframes see."""
        return np.flatnonzero(self.alive[: self.size] & (self.observations[: self.size] >= keyframes))

    def sigma_along_ray(self, rows: Ints, center_w: Floats) -> Floats:
        """Relative deviation ``(N,)`` of the distance of points from ``center_w`` ``(3,)``."""
        offset = self.position_w[rows] - center_w
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
        ray = offset / distance[:, None]
        variance = np.einsum("ni,nij,nj->n", ray, self.covariance_w[rows], ray)
        return np.sqrt(np.maximum(variance, 0.0)) / distance
