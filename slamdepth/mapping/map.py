# SPDX-License-Identifier: Apache-2.0
"""The sparse map: the only writer of keyframes and landmarks.

Landmarks live in growing arrays and are named by their index, so that whole arrays are worked on.
A landmark that dies keeps its id, and one that was fused into another points there through
``alias``, until :meth:`Map.compact` gives the ids to others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from slamdepth.geometry import Similarity, invert, transform
from slamdepth.mapping.keyframe_store import KeyframeStore, StoredFrame, StoredPrediction
from slamdepth.mapping.landmarks import AdjustedLandmarks, Landmarks
from slamdepth.mapping.map_keyframe import KeyframeState, MapKeyframe
from slamdepth.mapping.map_view import NEAREST_M, MapView
from slamdepth.types import DepthPrediction, Frame
from slamdepth.typing import Floats, Ints

__all__ = ["NEAREST_M", "AdjustedLandmarks", "Map", "MapKeyframe"]

_COMPACT_FROM = 4096
_YOUNG_KEYFRAMES = 3  # a landmark is on probation for so many keyframes (ORB-SLAM, Mur-Artal et al. 2015)
_MIN_FOUND_RATIO = 0.25
_ESTABLISHED = 3  # keyframes: what so many see is hidden by blur or an obstacle, not wrong


class Map(MapView):
    """Keyframes and the landmarks they see.

    Everybody may read (:class:`MapView`); arrays handed out are read-only. Changes are the methods below.
    Several maps can live next to each other.

    Args:
        keyframe_memory_mib: budget for images and depth maps of keyframes; beyond it the oldest are
            spilled to a temporary file.

    Attributes:
        session: number of the recording that new keyframes come from.
    """

    def __init__(self, keyframe_memory_mib: float = math.inf) -> None:
        super().__init__()
        self.session = 0
        self._compact_at = _COMPACT_FROM
        self._store = KeyframeStore(keyframe_memory_mib)

    def add_keyframe(
        self,
        frame: Frame,
        features: Any,
        T_camera_world: Floats,
        landmark_ids: Ints,
        velocity: Floats | None = None,
    ) -> MapKeyframe:
        """Add a keyframe that sees landmarks of the map; it has no depth yet.

        Args:
            features: its ``N`` :class:`~slamdepth.frontend.features.Features`.
            T_camera_world: ``(4, 4)``.
            landmark_ids: ``(N,)`` landmark each feature sees, -1 for none.
            velocity: ``(6,)`` m/s and rad/s in the camera frame; default: at rest.
        """
        count = len(landmark_ids)
        state = KeyframeState(
            id=len(self._states),
            frame=StoredFrame(frame),
            features=features,
            T_camera_world=T_camera_world.copy(),
            landmark_ids=landmark_ids.copy(),
            log_depth=np.full(count, np.nan),
            sigma_log=np.full(count, np.nan),
            velocity=np.zeros(6) if velocity is None else velocity.copy(),
            session=self.session,
        )
        self._states.append(state)
        self._sights.note(state.id, landmark_ids)
        self._own.observations[landmark_ids[landmark_ids >= 0]] += 1
        keyframe = MapKeyframe(state)
        self.keyframes = (*self.keyframes, keyframe)
        return keyframe

    def set_depth(
        self,
        keyframe: MapKeyframe,
        prediction: DepthPrediction,
        log_depth: Floats,
        sigma_log: Floats,
        *,
        predicted_log_depth: Floats | None = None,
        scale: float = 1.0,
    ) -> None:
        """Give a keyframe its depth; for the arguments see :class:`MapKeyframe`."""
        state = self._states[keyframe.id]
        state.prediction = StoredPrediction(prediction)
        state.log_depth, state.sigma_log = log_depth.copy(), sigma_log.copy()
        if predicted_log_depth is not None:
            state.predicted_log_depth = predicted_log_depth.copy()
        state.scale = scale

    def set_prior(self, keyframe: MapKeyframe, log_depth: Floats, sigma_log: Floats) -> None:
        """Give a keyframe's features a depth, for the arguments see :class:`MapKeyframe`."""
        state = self._states[keyframe.id]
        state.log_depth, state.sigma_log = log_depth.copy(), sigma_log.copy()

    def set_features(self, keyframe: MapKeyframe, features: Any) -> None:
        """Replace a keyframe's features by the same ones at corrected pixels."""
        self._states[keyframe.id].features = features

    def set_velocity(self, keyframe: MapKeyframe, velocity: Floats) -> None:
        """Say how the camera moved when the keyframe was taken: ``(6,)`` m/s and rad/s, camera frame."""
        self._states[keyframe.id].velocity = velocity.copy()

    def create_landmarks(
        self, keyframe: MapKeyframe, features: Ints, position_w: Floats, covariance_w: Floats
    ) -> Ints:
        """Initialise landmarks that ``keyframe`` sees.

        Args:
            features: ``(N,)`` its features without a landmark.
            position_w, covariance_w: ``(N, 3)`` metres and ``(N, 3, 3)`` m^2, world frame.

        Returns:
            Their ids ``(N,)``.
        """
        n, first = len(features), self.size
        descriptors = keyframe.features.descriptors
        if first == 0:  # the first landmarks say what a descriptor is
            self._own = self._own.empty(len(self._own), descriptors)
        while first + n > len(self._own):
            self._own = self._own.moved(np.arange(first), 2 * len(self._own))
        self.landmarks = self._own.read_only(first + n)
        ids = np.arange(first, first + n)
        own = self._own
        own.position_w[ids] = position_w
        own.covariance_w[ids] = covariance_w
        own.descriptor[ids] = descriptors[features]
        own.anchor_keyframe[ids] = keyframe.id
        own.octave[ids] = keyframe.features.octave[features]
        for counter in (own.expected, own.found, own.observations):
            counter[ids] = 1
        own.alive[ids] = True
        own.alias[ids] = ids
        self._states[keyframe.id].landmark_ids[features] = ids
        self._sights.note(keyframe.id, ids)
        self._refresh_views(ids)
        return ids

    def count_views(self, expected: Ints, found: Ints) -> None:
        """Count that a placed camera should have seen the landmarks ``expected`` and did see ``found``."""
        self._own.expected[expected] += 1
        self._own.found[found] += 1

    def observe(self, keyframe: MapKeyframe, features: Ints, ids: Ints) -> None:
        """Let ``features (N,)`` of a keyframe see the landmarks ``ids (N,)``, which it did not see before.

        Where a feature sees another landmark already, the two are fused into the one that more
        keyframes see.
        """
        own = self._own
        seen = self._states[keyframe.id].landmark_ids
        there = seen[features]
        free = there < 0
        seen[features[free]] = ids[free]
        self._sights.note(keyframe.id, ids[free])
        own.observations[ids[free]] += 1
        mine, theirs = ids[~free], there[~free]
        alive = (mine != theirs) & own.alive[mine] & own.alive[theirs]
        mine, theirs = mine[alive], theirs[alive]
        stronger = own.observations[mine] > own.observations[theirs]
        self.fuse(np.where(stronger, theirs, mine), np.where(stronger, mine, theirs))

    def fuse_view(self, keyframe: MapKeyframe, ids: Ints) -> None:
        """Join what a keyframe sees twice, once from each side of a loop.

        Args:
            ids: ``(N,)`` landmark of the other side that each feature agrees with, -1 for none. It replaces
                the keyframe's own.
        """
        own, seen = self._own, self._states[keyframe.id].landmark_ids
        present = np.zeros(self.size + 1, dtype=bool)
        present[seen] = True
        free = np.flatnonzero((ids >= 0) & (seen < 0))
        free = free[own.alive[ids[free]] & ~present[ids[free]]]
        seen[free] = ids[free]
        self._sights.note(keyframe.id, ids[free])
        own.observations[ids[free]] += 1
        both = np.flatnonzero((ids >= 0) & (seen >= 0) & (ids != seen))
        both = both[own.alive[ids[both]] & own.alive[seen[both]] & ~present[ids[both]]]
        self.fuse(seen[both], ids[both])

    def fuse(self, losers: Ints, winners: Ints) -> None:
        """Let each of ``winners (N,)`` take over the observations of the landmark ``losers (N,)``.

        A landmark occurs on one side only; several losers may share a winner. A keyframe that
        sees both keeps the winner's feature.
        """
        if len(losers) == 0:
            return
        target = np.arange(self.size)
        target[losers] = winners
        is_loser = self.mask(losers)
        own = self._own
        for k in self._sights.candidates(is_loser):
            ids = self._states[k].landmark_ids
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
            self._sights.note(k, winner[keeps])
            own.observations[winner[keeps]] += 1
        own.alive[losers] = False
        own.alias[losers] = winners
        np.add.at(own.expected, winners, own.expected[losers])
        np.add.at(own.found, winners, own.found[losers])

    def remove(self, ids: Ints) -> None:
        """Remove landmarks from the map and from every keyframe."""
        if len(ids) == 0:
            return
        self._own.alive[ids] = False
        dead = self.mask(ids)
        for k in self._sights.candidates(dead):
            seen = self._states[k].landmark_ids
            seen[dead[seen]] = -1

    def forget_observations(self, keyframe_ids: Ints, features: Ints) -> None:
        """Drop single observations, ``(N,)`` each; landmarks left with none are removed."""
        for k in np.unique(keyframe_ids):
            seen = self._states[k].landmark_ids
            at = features[keyframe_ids == k]
            ids = seen[at]
            seen[at] = -1
            np.subtract.at(self._own.observations, ids[ids >= 0], 1)
        size = self.size
        self._own.alive[:size] &= self._own.observations[:size] > 0

    def cull(self, newest: MapKeyframe) -> None:
        """Remove landmarks that are seldom found where expected, or that only one keyframe sees."""
        landmarks = self.landmarks
        age = newest.id - landmarks.anchor_keyframe
        seldom = landmarks.found < _MIN_FOUND_RATIO * landmarks.expected
        young = (age <= _YOUNG_KEYFRAMES) | (landmarks.observations < _ESTABLISHED)
        lonely = (landmarks.observations < 2) & (age >= _YOUNG_KEYFRAMES)
        invalid = ~np.isfinite(landmarks.position_w).all(axis=1)
        bad = (seldom & (age >= 1) & young) | lonely | invalid
        self.remove(np.flatnonzero(landmarks.alive & bad))

    def correct(
        self,
        keyframe_ids: Sequence[int],
        T_camera_world: Floats,
        *,
        adjusted: AdjustedLandmarks | None = None,
    ) -> None:
        """Move keyframes, and with each the landmarks that are anchored to it.

        Poses that are stored as :class:`~slamdepth.mapping.map_keyframe.AnchoredPose` follow by themselves.

        Args:
            keyframe_ids: ``M`` keyframes; the others stay.
            T_camera_world: ``(M, 4, 4)`` their new poses.
            adjusted: landmarks whose new place is known otherwise.
        """
        own = self._own
        moves = self.landmarks.alive.copy()
        if adjusted is not None:
            moves[adjusted.ids] = False
        is_moved = np.zeros(len(self._states), dtype=bool)
        is_moved[keyframe_ids] = True
        riders = np.flatnonzero(is_moved[self.landmarks.anchor_keyframe] & moves)
        anchor = self.landmarks.anchor_keyframe[riders]
        for k, T_new in zip(keyframe_ids, T_camera_world, strict=True):
            state = self._states[k]
            anchored = riders[anchor == k]
            T_world_before = invert(T_new) @ state.T_camera_world
            R = T_world_before[:3, :3]
            own.position_w[anchored] = transform(T_world_before, own.position_w[anchored])
            own.covariance_w[anchored] = R @ own.covariance_w[anchored] @ R.T
            state.T_camera_world = T_new.copy()
        if adjusted is not None:
            own.position_w[adjusted.ids] = adjusted.position_w
            own.covariance_w[adjusted.ids] = adjusted.covariance_w
            self._refresh_views(adjusted.ids)

    def correct_similarities(self, T_world_camera: Floats, scales: Floats) -> None:
        """Move every keyframe by a similarity, and with it the landmarks that are anchored to it.

        Args:
            T_world_camera: ``(K, 4, 4)`` new poses of all keyframes.
            scales: ``(K,)`` factor on each keyframe's metres: on the depths seen from it.
        """
        own, size = self._own, self.size
        anchor = self.landmarks.anchor_keyframe
        T_camera_old, T_new = invert(self.T_world_camera)[anchor], T_world_camera[anchor]
        position_c = np.einsum("nij,nj->ni", T_camera_old[:, :3, :3], own.position_w[:size])
        position_c = (position_c + T_camera_old[:, :3, 3]) * scales[anchor][:, None]
        own.position_w[:size] = np.einsum("nij,nj->ni", T_new[:, :3, :3], position_c) + T_new[:, :3, 3]
        R = T_new[:, :3, :3] @ T_camera_old[:, :3, :3]
        covariance_w = R @ own.covariance_w[:size] @ np.swapaxes(R, 1, 2)
        own.covariance_w[:size] = covariance_w * (scales[anchor] ** 2)[:, None, None]
        for state, T, scale in zip(self._states, T_world_camera, scales.tolist(), strict=True):
            state.T_camera_world = invert(T)
            _scale_depths(state, scale)
        self._refresh_views(np.arange(size))

    def rescale(self, factor: float) -> None:
        """Multiply the metres of the whole map; the origin of the world stays."""
        own, size = self._own, self.size
        own.position_w[:size] *= factor
        own.covariance_w[:size] *= factor**2
        for state in self._states:
            T_camera_world = state.T_camera_world.copy()
            T_camera_world[:3, 3] *= factor
            state.T_camera_world = T_camera_world
            _scale_depths(state, factor)
        self._refresh_views(np.arange(size))

    def move(self, similarity: Similarity) -> None:
        """Express the whole map in another world frame, and in its metres."""
        count = len(self.keyframes)
        self.correct_similarities(similarity.camera(self.T_world_camera), np.full(count, similarity.scale))

    def absorb(self, other: Map) -> tuple[int, int]:
        """Take over all keyframes and landmarks of a map in the same world frame.

        They follow behind this map's own, whenever they were taken. The other map must not be used any more;
        its :class:`MapKeyframe` and what is anchored to them belong to this map.

        Returns:
            The ids that the first keyframe and the first landmark taken over have from now on.
        """
        first_keyframe, first_landmark = len(self._states), self.size
        self._own = self._own.joined(first_landmark, other.landmarks, first_keyframe)
        self.landmarks = self._own.read_only(len(self._own))
        self._compact_at = max(self._compact_at, 2 * self.size)
        for state in other._states:
            state.id += first_keyframe
            state.landmark_ids = np.where(state.landmark_ids >= 0, state.landmark_ids + first_landmark, -1)
        self._states += other._states
        self._sights.rebuild(state.landmark_ids for state in self._states)
        self.keyframes = (*self.keyframes, *other.keyframes)
        self.starts |= {first_keyframe + start for start in other.starts}
        return first_keyframe, first_landmark

    def _refresh_views(self, ids: Ints) -> None:
        """Recompute how landmarks are seen from their anchor keyframes."""
        own = self._own
        anchors, anchor = np.unique(own.anchor_keyframe[ids], return_inverse=True)
        centers = np.array([self.keyframes[k].center_w for k in anchors.tolist()]).reshape(-1, 3)
        offset = own.position_w[ids] - centers[anchor]
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        own.distance_m[ids] = distance
        own.direction_w[ids] = offset / distance[:, None]

    def restore(
        self,
        states: Sequence[KeyframeState],
        landmarks: Landmarks,
        starts: Iterable[int],
        compact_at: int | None = None,
        stored: Sequence[Any] | None = None,
    ) -> None:
        """Fill an empty map with what was saved of one.

        Args:
            states: with ids from 0.
            landmarks: copied.
            compact_at: number of landmarks that the next :meth:`compact` waits for; None as after one.
            stored: which images were in memory, see :attr:`stored`; None: those of all ``states``.
        """
        size = len(landmarks)
        self._states = list(states)
        self._own = landmarks.moved(np.arange(size), max(_COMPACT_FROM, size))
        self.landmarks = self._own.read_only(size)
        self._sights.rebuild(state.landmark_ids for state in self._states)
        self.keyframes = tuple(MapKeyframe(state) for state in self._states)
        self.starts = frozenset(starts)
        self._compact_at = max(_COMPACT_FROM, 2 * size) if compact_at is None else compact_at
        if stored is not None:
            self._store.restore(stored, self._states)

    def begin_sessions(self) -> None:
        """All keyframes come from one recording, which is the first one of the map."""
        self.session = 0
        for state in self._states:
            state.session = 0

    def renumber_sessions(self, first: int) -> None:
        """The recordings follow behind ``first`` others from now on."""
        self.session += first
        for state in self._states:
            state.session += first

    @property
    def compact_at(self) -> int:
        """Number of landmarks that the next :meth:`compact` waits for."""
        return self._compact_at

    @property
    def stored(self) -> Sequence[Any]:
        """Which images and depth maps are in memory, for a checkpoint."""
        return self._store.state()

    def compact(self, *, at_once: bool = False) -> Ints | None:
        """Give away the ids of landmarks that are gone, once there are twice as many as after the last time.

        The order of the others stays.

        Args:
            at_once: however few there are.

        Returns:
            ``(size + 1,)`` the new id of each landmark, -1 where it is gone, and a last -1 for none: whoever
            remembers ids must look them up. None where nothing changed.
        """
        n = self.size
        if n < self._compact_at and not at_once:
            return None
        is_kept = np.append(self.landmarks.alive, False)
        for state in self._states:
            is_kept[state.landmark_ids] = True
        is_kept[-1] = False
        kept = np.flatnonzero(is_kept)
        now = np.full(n + 1, -1, dtype=np.int64)
        now[kept] = np.arange(len(kept))
        fused_into = self.resolve(np.arange(n))
        now[:n] = np.where(is_kept[:n], now[:n], now[fused_into])
        self._own.alias[:n] = np.where(fused_into >= 0, fused_into, np.arange(n))
        self._compact_at = max(_COMPACT_FROM, 2 * len(kept))
        self._own = self._own.moved(kept, self._compact_at)
        self._own.alias[: len(kept)] = now[self._own.alias[: len(kept)]]
        self.landmarks = self._own.read_only(len(kept))
        for state in self._states:
            state.landmark_ids = now[state.landmark_ids]
        self._sights.rebuild(state.landmark_ids for state in self._states)
        return now

    def spill_images(self) -> None:
        """Keep the images and depth maps of keyframes within the budget of memory."""
        self._store.tidy(self._states)

    def spill_all_images(self) -> None:
        """Keep images and depth maps of the newest keyframes only: the camera has left this map."""
        self._store.tidy(self._states, budget_bytes=0)


def _scale_depths(state: KeyframeState, factor: float) -> None:
    """Multiply what a keyframe knows in metres."""
    state.log_depth = state.log_depth + np.log(factor)
    state.scale *= factor
    state.unit *= factor
    state.velocity = state.velocity * np.repeat([factor, 1.0], 3)
