# SPDX-License-Identifier: Apache-2.0
"""Closing loops: a place seen before, verified by geometry, joined in one map."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from slamdepth.backend.pose_graph import Edge, PoseGraphResult, optimise_pose_graph
from slamdepth.config import Config
from slamdepth.geometry import Similarity, invert, rotation_angle_rad
from slamdepth.io.tree import Tree
from slamdepth.loops.consistency import Drift, RefusedLoops
from slamdepth.loops.edges import (
    MeasuredLoop,
    edge_arrays,
    edges_of,
    loop_arrays,
    loops_of,
    odometry_edges,
    weakness,
)
from slamdepth.loops.look_alikes import (
    ALREADY_LINKED,
    FEWEST_DEPTHS,
    View,
    depths_in_both,
    distance_seen_m,
    fits_elsewhere,
)
from slamdepth.loops.meeting import Meeting
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.loops.trial import Sighting, Trial, part_between, parts_that_meet
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.placement import Placement
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

log = logging.getLogger(__name__)

_CANDIDATES = 2  # of those that look most alike, and of those that odometry allows
_MIN_SCORE_SHARE = 0.6  # of the similarity of two neighbours in time
_MIN_VERIFIED = 15  # matches that verification starts from
_LOOP_SIGMAS = (0.01, 0.02, 0.03)  # radians, metres, natural logarithm of the scale
_LIKELY = 0.5  # of the largest drift that is believed: 1.5 deviations instead of three
_LOOSER = (2.0, 4.0, 8.0)  # factors on the odometry's deviations, once confirmed loops contradict it


class Verifier(Protocol):
    """Places a camera by matching its features with one keyframe."""

    def from_keyframe(
        self, features: Any, keyframe_id: int, *, minimum: int | None = None
    ) -> Placement | None: ...


@dataclass(frozen=True)
class LoopClosure:
    """A loop that was closed.

    Attributes:
        candidate: the earlier keyframe whose place was seen.
        scales: ``(K,)`` factor on each keyframe's metres.
    """

    candidate: int
    scales: Floats


class LoopCloser:
    """Finds loops of new keyframes and corrects the map so that they close.

    Attributes:
        places: index of keyframes by what they look like.
        count: loops closed; a revisit that links many keyframes in a row is one.
        refused: verified loops that were not believed.
        taken_back: those of them that the pose graph believed, and the observations did not.
    """

    def __init__(self, camera: Camera, config: Config, map_: Map, verifier: Verifier) -> None:
        self._camera = camera
        self._config = config
        self._map = map_
        self._verifier = verifier
        self.places = PlaceRecogniser()
        self._loops: list[MeasuredLoop] = []
        self._refused = RefusedLoops()
        self._last: tuple[int, int] | None = None
        self.count = 0
        self.refused = 0
        self.taken_back = 0

    def describe(self, features: Any) -> NDArray[np.float32]:
        """The place vector of an image's features; any thread may ask."""
        return self.places.describe(features.place_descriptors)

    def close(self, keyframe: MapKeyframe, words: NDArray[np.float32]) -> LoopClosure | None:
        """Index a keyframe and look for a loop at it; where one closes, the map has been corrected.

        Args:
            words: place vector of its features, see :meth:`describe`.
        """
        self.places.add_vector(keyframe.id, words)
        if not self._config.loops.enabled:
            return None
        looking_alike = self._looking_alike(keyframe)
        if not looking_alike:
            return None
        drift = self.drift()
        alike, allowed = self._chosen(keyframe, looking_alike, drift)
        for candidate in dict.fromkeys([*alike, *allowed]):
            verified = self.verify(keyframe, candidate)
            if verified is None:
                continue
            placement, scale = verified
            edge = self._edge(keyframe, candidate, placement, scale)
            if candidate not in alike and not drift.explains(edge):
                continue  # a place that looks alike, where the true one was looked for
            scales = self._apply(keyframe, edge, placement, drift)
            if scales is not None:
                if self._is_new(keyframe.id, candidate):
                    self.count += 1
                self._last = (keyframe.id, candidate)
                log.info("loop closed: keyframe %d sees the place of keyframe %d", keyframe.id, candidate)
                return LoopClosure(candidate, scales)
        return None

    def may_join(self, other: MapView, meetings: Sequence[Meeting], similarity: Similarity) -> bool:
        """Whether this map and another one still reproject as one map; where not, a loop is taken back.

        Args:
            meetings: of keyframes of this map.
            similarity: from this map to the other one.
        """
        sightings = [Sighting(meeting.keyframe, meeting.landmark_ids) for meeting in meetings]
        there, here = parts_that_meet(self._map, other, sightings)
        scales = np.full(len(self._map.keyframes), similarity.scale)
        moved = here.corrected(similarity.camera(self._map.T_world_camera), scales)
        why = Trial(self._camera, self._config.bundle, [there, here], sightings).worsened([there, moved])
        if why:
            self._take_back("the join of two maps", why)
        return not why

    def join(self, other: LoopCloser, first: int, meetings: Sequence[Meeting]) -> None:
        """Take over keyframes and loops of a map that this map has absorbed.

        Args:
            first: number of the other map's first keyframe in this map.
            meetings: what the two maps were joined by; they are loops from now on.
        """
        self.places.absorb(other.places, first)
        self._refused.clear()
        self._last = None
        self.count += other.count
        self.refused += other.refused
        self.taken_back += other.taken_back
        self._loops += [loop.renumbered(first) for loop in other._loops]
        units = self._map.units
        for meeting in meetings:
            self._loops.append(MeasuredLoop.of(meeting.edge(_LOOP_SIGMAS), units))
            self._map.fuse_view(meeting.keyframe, meeting.landmark_ids)

    @property
    def measured(self) -> list[MeasuredLoop]:
        """The loops that were closed, as they were measured."""
        return list(self._loops)

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {
            "places": self.places.state(),
            "loops": loop_arrays(self._loops),
            "refused_edges": edge_arrays(self._refused.edges),
            "last": self._last,
            "counts": [self.count, self.refused, self.taken_back],
        }

    def load(
        self, places: Mapping[str, NDArray[Any]], loops: Sequence[MeasuredLoop], loop_closures: int
    ) -> None:
        """Go on from a saved map.

        Args:
            places: see :meth:`PlaceRecogniser.state`.
            loops: as they were measured.
            loop_closures: that were closed in it.
        """
        self.places.restore(places)
        self._loops = list(loops)
        self.count = loop_closures

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self.places.restore(state["places"])
        self._loops = loops_of(state["loops"])
        self._refused.restore(edges_of(state["refused_edges"], is_loop=True))
        last = state["last"]
        self._last = None if last is None else (last[0], last[1])
        self.count, self.refused, self.taken_back = state["counts"]

    def _is_new(self, keyframe: int, candidate: int) -> bool:
        if self._last is None:
            return True
        gap = self._config.loops.min_gap
        return keyframe - self._last[0] > gap or abs(candidate - self._last[1]) > gap

    def candidates(self, keyframe: MapKeyframe, drift: Drift) -> tuple[list[int], list[int]]:
        """Earlier keyframes that look like ``keyframe`` and share no landmarks with it, best first.

        Where places look alike, the true one is seldom among the best by appearance.

        Returns:
            Of all, and of those that may see the same surfaces as far as odometry can have drifted.
        """
        return self._chosen(keyframe, self._looking_alike(keyframe), drift)

    def _looking_alike(self, keyframe: MapKeyframe) -> list[int]:
        """All earlier keyframes that look like ``keyframe`` and share no landmarks with it, best first."""
        newest = keyframe.id - self._config.loops.min_gap
        if newest < 0:
            return []
        shared = self._map.shared_landmarks(keyframe.landmark_ids)
        exclude = {k for k in range(len(shared)) if k > newest or shared[k] >= ALREADY_LINKED}
        least = _MIN_SCORE_SHARE * self.places.score(keyframe.id, keyframe.id - 1)
        answers = self.places.query_keyframe(keyframe.id, exclude=exclude, top_k=newest + 1)
        return [k for k, score in answers if score >= least]

    def _chosen(self, keyframe: MapKeyframe, alike: list[int], drift: Drift) -> tuple[list[int], list[int]]:
        """The best of those that look alike, and of those among them that odometry allows."""
        nearby = set(drift.nearby(keyframe.id, self._distance_m(keyframe)).tolist())
        return alike[:_CANDIDATES], [k for k in alike if k in nearby][:_CANDIDATES]

    def _distance_m(self, keyframe: MapKeyframe) -> float:
        """Median distance of what a keyframe sees."""
        return distance_seen_m(self._map, keyframe.T_camera_world, keyframe.landmark_ids)

    def verify(self, keyframe: MapKeyframe, candidate: int) -> tuple[Placement, float] | None:
        """Where ``candidate`` places ``keyframe``, and the ratio of their metres.

        Returns:
            None where too few landmarks of the candidate's place are seen.
        """
        placement = self._verifier.from_keyframe(keyframe.features, candidate, minimum=_MIN_VERIFIED)
        if placement is None or placement.inliers < self._config.loops.min_inliers:
            return None
        both = np.flatnonzero((placement.landmark_ids >= 0) & (keyframe.landmark_ids >= 0))
        both = both[placement.landmark_ids[both] != keyframe.landmark_ids[both]]
        scale = 1.0
        if not self._map.is_measured:
            there, here = depths_in_both(
                (self._map, placement.T_camera_world, placement.landmark_ids[both]),
                (self._map, keyframe.T_camera_world, keyframe.landmark_ids[both]),
            )
            if len(there) >= FEWEST_DEPTHS:
                scale = float(np.exp(np.median(np.log(there / here))))
        return placement, scale

    def _edge(self, keyframe: MapKeyframe, candidate: int, placement: Placement, scale: float) -> Edge:
        T_loop = self._map.keyframes[candidate].T_camera_world @ invert(placement.T_camera_world)
        return Edge(candidate, keyframe.id, T_loop, scale, _LOOP_SIGMAS, is_loop=True)

    def drift(self) -> Drift:
        """How far odometry may have drifted up to now."""
        shared = self._map.shared_with_next()
        return Drift(self._map.T_world_camera, weakness(shared), self._map.is_measured)

    def _apply(self, keyframe: MapKeyframe, edge: Edge, placement: Placement, drift: Drift) -> Floats | None:
        """Correct the map by a verified loop; returns the scales ``(K,)``, None where the loop is refused."""
        new = [edge]
        scales = np.ones(len(self._map.keyframes))
        units = self._map.units
        if _is_off(keyframe, placement, edge.scale_i_j):
            T_old, together = self._map.T_world_camera, self._map.covisibility()
            result = self._optimised(T_old, together, new)
            if result is None:
                new = self._refused.confirmed(edge, drift)
                # where places look alike false loops are common: a likely drift must explain this one
                is_likely = drift.explains(edge, _LIKELY)
                if new and (is_likely or not self._has_look_alike(keyframe, edge, placement)):
                    result = self._optimised_after_drift(T_old, together, new)
            if result is None:
                self._refused.add(edge, drift)
                self.refused += 1
                log.info("loop %d-%d refused by the pose graph", edge.i, keyframe.id)
                return None
            if why := self._worsened(keyframe, edge, placement, result):
                self._take_back(f"loop {edge.i}-{keyframe.id}", why)
                return None
            scales = result.scales
            self._map.correct_similarities(result.T_world_camera, scales)
            self._refused.clear()
        self._loops += [MeasuredLoop.of(loop, units) for loop in new]
        self._map.count_views(placement.expected_ids, placement.found_ids)
        self._map.fuse_view(keyframe, placement.landmark_ids)
        return scales

    def _worsened(
        self, keyframe: MapKeyframe, edge: Edge, placement: Placement, result: PoseGraphResult
    ) -> str:
        """How the map would reproject worse after a correction; empty where it would not."""
        part = part_between(self._map, *sorted((edge.i, edge.j)))
        sightings = [Sighting(keyframe, placement.landmark_ids)]
        trial = Trial(self._camera, self._config.bundle, [part], sightings)
        return trial.worsened([part.corrected(result.T_world_camera, result.scales)])

    def _take_back(self, what: str, why: str) -> None:
        self.refused += 1
        self.taken_back += 1
        log.info("%s is taken back: %s", what, why)

    def _has_look_alike(self, keyframe: MapKeyframe, edge: Edge, placement: Placement) -> bool:
        """Whether the place of a loop looks like another one, before the keyframes that see it again."""
        candidate, vector = self._map.keyframes[edge.i], self.places.vector
        here = View.of(keyframe, vector(keyframe.id))
        views = (
            replace(here, T_camera_world=placement.T_camera_world),
            View.of(candidate, vector(candidate.id)),
        )
        distance_m, fewest = self._distance_m(keyframe), self._config.loops.min_inliers
        newest = keyframe.id - self._config.loops.min_gap
        return any(fits_elsewhere(view, self, distance_m, fewest, newest=newest) for view in views)

    @property
    def map(self) -> MapView:
        """The map whose loops are closed."""
        return self._map

    def place_view(self, features: Any, candidate: int) -> Placement | None:
        """Place an image by matching its features with the keyframe ``candidate``."""
        return self._verifier.from_keyframe(features, candidate, minimum=_MIN_VERIFIED)

    def _optimised(
        self, T_old: Floats, together: Ints, new: list[Edge], looser: float = 1.0
    ) -> PoseGraphResult | None:
        """The pose graph with the loops ``new``; None where one of them is an outlier."""
        units = self._map.units
        kept = [loop.in_units(units) for loop in self._loops]
        edges = [*odometry_edges(self._map, together, looser), *kept, *new]
        result = optimise_pose_graph(T_old, edges, with_scale=not self._map.is_measured)
        return result if result.is_inlier[-len(new) :].all() else None

    def _optimised_after_drift(
        self, T_old: Floats, together: Ints, confirmed: list[Edge]
    ) -> PoseGraphResult | None:
        """The pose graph with odometry believed less, where several loops agree that odometry drifted."""
        if not confirmed:
            return None
        for looser in _LOOSER:
            result = self._optimised(T_old, together, confirmed, looser)
            if result is not None:
                log.info("%d loops agree on a large drift", len(confirmed))
                return result
        return None


def _is_off(keyframe: MapKeyframe, placement: Placement, scale: float) -> bool:
    """Whether a loop differs enough from the present pose to correct the map."""
    D = placement.T_camera_world @ keyframe.T_world_camera
    far = float(np.linalg.norm(D[:3, 3])) > 0.02
    return far or float(rotation_angle_rad(D[:3, :3])) > np.deg2rad(1.0) or abs(np.log(scale)) > 0.03
