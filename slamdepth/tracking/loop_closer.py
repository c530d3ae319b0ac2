# SPDX-License-Identifier: Apache-2.0
"""Closing loops: a place seen before, verified by geometry, brought into one map."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.backend.pose_graph import Edge, PoseGraphResult, optimise_pose_graph
from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import invert, rotation_angle_rad, transform
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.landmarks import NEAREST_M, LandmarkMap, MapKeyframe
from slamdepth.tracking.localiser import Localiser, Placement
from slamdepth.tracking.refused_loops import STEP_SIGMAS, RefusedLoops
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


log = logging.getLogger(__name__)

_ALREADY_LINKED = 15  # shared points that make two keyframes neighbours
_CANDIDATES = 2
_COVISIBLE = 80  # shared points that make an edge of the pose graph
_PARTNERS = 10  # earlier keyframes that one is tied to at most, beside the one just before it
_MIN_SCORE_SHARE = 0.6  # of the likeness of two neighbours in time
_LOOSER = (2.0, 4.0, 8.0)  # the odometry's deviations, times this, once confirmed loops contradict them


@dataclass(frozen=True)
class Correction:
    """What a loop did to the map.

    Attributes:
        scales: ``(K,)`` factor each keyframe's metres were multiplied by.
    """

    scales: NDArray[np.float64]


class LoopCloser:
    """Finds loops of new keyframes and bends the map so that they close."""

    def __init__(self, config: Config, landmarks: LandmarkMap, localiser: Localiser) -> None:
        self._config = config
        self._map = landmarks
        self._localiser = localiser
        self.places = PlaceRecogniser()
        self._edges: list[Edge] = []
        self._refused = RefusedLoops()
        self._last: tuple[int, int] | None = None
        self.count = 0

    def describe(self, features: Features) -> NDArray[np.float32]:
        """The words an image shows; any thread may ask."""
        return self.places.describe(features.place_descriptors)

    def add(self, keyframe: MapKeyframe, words: NDArray[np.float32]) -> None:
        """Let the keyframe be found by later ones.

        Args:
            words: what :meth:`describe` says of its features.
        """
        self.places.add_vector(keyframe.id, words)

    def close(self, keyframe: MapKeyframe) -> Correction | None:
        """Look for a loop at ``keyframe``; on success the map has been corrected."""
        if not self._config.loops.enabled:
            return None
        for candidate in self.candidates(keyframe):
            verified = self.verify(keyframe, candidate)
            if verified is None:
                continue
            placement, scale = verified
            correction = self._correct(keyframe, candidate, placement, scale)
            if correction is not None:
                if self._is_new(keyframe.id, candidate):
                    self.count += 1
                self._last = (keyframe.id, candidate)
                log.info("loop closed: keyframe %d sees the place of keyframe %d", keyframe.id, candidate)
                return correction
        return None

    def _is_new(self, keyframe: int, candidate: int) -> bool:
        """A revisit links many keyframes in a row; it is one loop."""
        if self._last is None:
            return True
        gap = self._config.loops.min_gap
        return keyframe - self._last[0] > gap or abs(candidate - self._last[1]) > gap

    def candidates(self, keyframe: MapKeyframe) -> list[int]:
        """Earlier keyframes that look like ``keyframe`` and share no points with it, best first."""
        newest = keyframe.id - self._config.loops.min_gap
        if newest < 0:
            return []
        shared = self._map.shared_points(keyframe.point_ids)
        exclude = {k for k in range(len(shared)) if k > newest or shared[k] >= _ALREADY_LINKED}
        least = _MIN_SCORE_SHARE * self.places.score(keyframe.id, keyframe.id - 1)
        answers = self.places.query_keyframe(keyframe.id, exclude=exclude, top_k=_CANDIDATES)
        return [k for k, score in answers if score >= least]

    def verify(self, keyframe: MapKeyframe, candidate: int) -> tuple[Placement, float] | None:
        """Where ``candidate`` places ``keyframe``, and the ratio of its metres; None where it sees it not."""
        placement = self._localiser.from_keyframe(keyframe.features, candidate, minimum=15)
        if placement is None or placement.inliers < self._config.loops.min_inliers:
            return None
        both = np.flatnonzero((placement.point_ids >= 0) & (keyframe.point_ids >= 0))
        both = both[placement.point_ids[both] != keyframe.point_ids[both]]
        scale = 1.0
        if not self._map.is_measured and len(both) >= 10:
            there = transform(placement.T_camera_world, self._map.position_w[placement.point_ids[both]])[:, 2]
            here = transform(keyframe.T_camera_world, self._map.position_w[keyframe.point_ids[both]])[:, 2]
            ok = (there > NEAREST_M) & (here > NEAREST_M)
            if np.count_nonzero(ok) >= 10:
                scale = float(np.exp(np.median(np.log(there[ok] / here[ok]))))
        return placement, scale

    def _correct(
        self, keyframe: MapKeyframe, candidate: int, placement: Placement, scale: float
    ) -> Correction | None:
        other = self._map.keyframes[candidate]
        T_loop = other.T_camera_world @ invert(placement.T_camera_world)
        edge = Edge(candidate, keyframe.id, T_loop, scale, self._sigmas(), is_loop=True)
        new = [edge]
        scales = np.ones(len(self._map.keyframes))
        if self._is_off(keyframe, placement, scale):
            T_old = np.stack([k.T_world_camera for k in self._map.keyframes])
            result = self._optimised(T_old, new)
            if result is None:
                new = self._refused.confirmed(edge, T_old, with_scale=not self._map.is_measured)
                result = self._optimised_after_drift(T_old, new)
            if result is None:
                self._refused.add(edge)
                new = self._refused.insisted(T_old, with_scale=not self._map.is_measured)
                result = self._optimised_after_break(T_old, new)
            if result is None:
                log.info("loop %d-%d refused by the pose graph", candidate, keyframe.id)
                return None
            scales = result.scales
            self._bend(T_old, result.T_world_camera, scales)
            self._refused.forget()
            self._edges = [_rescaled(e, scales) for e in self._edges]
            new = [_rescaled(e, scales) for e in new]
        self._edges += new
        self._unite(keyframe, placement)
        return Correction(scales)

    def _optimised(self, T_old: Floats, new: list[Edge], looser: float = 1.0) -> PoseGraphResult | None:
        """The pose graph with the loops ``new``; None where it takes one of them for false."""
        edges = [*self._odometry_edges(looser), *self._edges, *new]
        result = optimise_pose_graph(T_old, edges, with_scale=not self._map.is_measured)
        return result if result.is_inlier[-len(new) :].all() else None

    def _optimised_after_drift(self, T_old: Floats, confirmed: list[Edge]) -> PoseGraphResult | None:
        """The same where several loops agree that it is the odometry that errs."""
        if not confirmed:
            return None
        for looser in _LOOSER:
            result = self._optimised(T_old, confirmed, looser)
            if result is not None:
                log.info("%d loops agree on a large drift", len(confirmed))
                return result
        return None

    def _optimised_after_break(self, T_old: Floats, insisted: list[Edge]) -> PoseGraphResult | None:
        """The same where one keyframe after the other sees another place than odometry has led to.

        Odometry is believed up to where two keyframes share fewest points, and hardly from there on.
        """
        if not insisted:
            return None
        together = self._map.covisibility()
        before, after = max(edge.i for edge in insisted), min(edge.j for edge in insisted)
        if before >= after:
            return None
        links = together[np.arange(before, after), np.arange(before + 1, after + 1)]
        last_good = before + int(np.argmin(links))
        edges = [*self._odometry_edges(_LOOSER[-1], after=last_good), *self._edges]
        edges += [replace(edge, is_loop=False) for edge in insisted]
        log.info("%d loops insist: odometry is not believed after keyframe %d", len(insisted), last_good)
        return optimise_pose_graph(T_old, edges, with_scale=not self._map.is_measured)

    def _is_off(self, keyframe: MapKeyframe, placement: Placement, scale: float) -> bool:
        D = placement.T_camera_world @ keyframe.T_world_camera
        far = float(np.linalg.norm(D[:3, 3])) > 0.02
        return far or float(rotation_angle_rad(D[:3, :3])) > np.deg2rad(1.0) or abs(np.log(scale)) > 0.03

    def _sigmas(self) -> tuple[float, float, float]:
        return (0.01, 0.02, 0.03)

    def _odometry_edges(self, looser: float = 1.0, *, after: int = -1) -> list[Edge]:
        """Neighbours in time, and those that share most points: what holds the graph's shape.

        A keyframe's edges all come from the same observations, so each counts for its share only.

        Args:
            looser: factor on the deviations of what leads to keyframes after ``after``, by default to all.
        """
        keyframes = self._map.keyframes
        together = self._map.covisibility()
        edges = []
        for j, keyframe in enumerate(keyframes[1:], start=1):
            shared = together[j, :j]
            best = np.argsort(-shared, kind="stable")[:_PARTNERS]
            partners = {j - 1, *best[shared[best] >= _COVISIBLE].tolist()}
            for i in sorted(partners):
                T_i_j = keyframes[i].T_camera_world @ keyframe.T_world_camera
                factor = np.sqrt(len(partners)) * (looser if j > after else 1.0)
                rotation, translation, log_scale = (s * factor for s in STEP_SIGMAS)
                edges.append(Edge(i, j, T_i_j, 1.0, (rotation, translation, log_scale)))
        return edges

    def _bend(self, T_old: Floats, T_new: Floats, scales: Floats) -> None:
        """Move points with the keyframe they were born in, and keyframes to their new poses."""
        landmarks = self._map
        birth = landmarks.birth_keyframe[: landmarks.size]
        old_c = (
            np.einsum("nij,nj->ni", invert(T_old)[birth][:, :3, :3], landmarks.position_w[: landmarks.size])
            + invert(T_old)[birth][:, :3, 3]
        )
        old_c *= scales[birth][:, None]
        landmarks.position_w[: landmarks.size] = (
            np.einsum("nij,nj->ni", T_new[birth][:, :3, :3], old_c) + T_new[birth][:, :3, 3]
        )
        R = T_new[birth][:, :3, :3] @ np.swapaxes(T_old[birth][:, :3, :3], 1, 2)
        landmarks.covariance_w[: landmarks.size] = (
            R @ landmarks.covariance_w[: landmarks.size] @ np.swapaxes(R, 1, 2)
        ) * (scales[birth] ** 2)[:, None, None]
        for k, keyframe in enumerate(landmarks.keyframes):
            keyframe.T_camera_world = invert(T_new[k])
            keyframe.log_depth += np.log(scales[k])
            keyframe.scale *= float(scales[k])
            keyframe.velocity[:3] *= scales[k]
        landmarks.refresh_views(np.arange(landmarks.size))

    def _unite(self, keyframe: MapKeyframe, placement: Placement) -> None:
        """What the keyframe sees as two points, once from each side of the loop, becomes one."""
        landmarks = self._map
        old, own = placement.point_ids, keyframe.point_ids
        present = np.zeros(landmarks.size + 1, dtype=bool)
        present[own] = True
        fresh = np.flatnonzero((old >= 0) & (own < 0))
        fresh = fresh[landmarks.alive[old[fresh]] & ~present[old[fresh]]]
        own[fresh] = old[fresh]
        landmarks.observations[old[fresh]] += 1
        both = np.flatnonzero((old >= 0) & (own >= 0) & (old != own))
        both = both[landmarks.alive[old[both]] & landmarks.alive[own[both]] & ~present[old[both]]]
        landmarks.merge(own[both], old[both])


def _rescaled(edge: Edge, scales: Floats) -> Edge:
    """The same measurement after the metres of each keyframe ``(K,)`` were multiplied."""
    T_i_j = edge.T_i_j.copy()
    T_i_j[:3, 3] *= scales[edge.i]
    return replace(edge, T_i_j=T_i_j, scale_i_j=edge.scale_i_j * scales[edge.i] / scales[edge.j])
