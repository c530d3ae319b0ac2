# SPDX-License-Identifier: Apache-2.0
"""Places that look alike: whether a view fits a map in more than one place.

Verification by geometry cannot tell two equal desks from one another. That a map has such places it can tell:
a view then fits elsewhere as well, by the same verification.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from slamdepth.geometry import invert, rotation_angle_rad, transform
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.mapping.map_view import NEAREST_M, MapView
from slamdepth.mapping.placement import Placement
from slamdepth.typing import Floats, Floats32, Ints

ALREADY_LINKED = 15
"""Shared landmarks that make two keyframes neighbours."""

FEWEST_DEPTHS = 10
"""Features with a landmark on both sides, from which on the ratio of their metres is known."""

_TRIED = 8  # keyframes that look most alike
_ELSEWHERE = (0.3, 0.3)  # radians, and share of the distance of what is seen: more is another place


class Place(Protocol):
    """A map, as far as a keyframe can be looked for in it."""

    @property
    def map(self) -> MapView: ...

    @property
    def places(self) -> PlaceRecogniser: ...

    def place_view(self, features: Any, candidate: int) -> Placement | None:
        """Place an image by matching its features with the keyframe ``candidate`` of this map."""
        ...


@dataclass(frozen=True)
class View:
    """An image that is said to be in a place of a map.

    Attributes:
        features: its :class:`~slamdepth.frontend.features.Features`, ``N`` of them.
        words: its place vector ``(W,)``.
        T_camera_world: ``(4, 4)`` where it is said to be in the map.
        landmark_ids: ``(N,)`` landmarks of the map that it sees there, -1 for none; None where they are not
            known, as those of a keyframe of another map.
    """

    features: Any
    words: Floats32
    T_camera_world: Floats
    landmark_ids: Ints | None = None

    @staticmethod
    def of(keyframe: MapKeyframe, words: Floats32) -> View:
        """A keyframe where its own map has it."""
        return View(keyframe.features, words, keyframe.T_camera_world, keyframe.landmark_ids)


@dataclass(frozen=True)
class Reach:
    """Where a camera can have got to: within ``radius_m`` of ``center_w (3,)``."""

    center_w: Floats
    radius_m: float

    def includes(self, T_camera_world: Floats) -> bool:
        """Whether a camera at ``T_camera_world (4, 4)`` is within reach."""
        center_w = invert(T_camera_world)[:3, 3]
        return bool(np.linalg.norm(center_w - self.center_w) <= self.radius_m)


def distance_seen_m(map_: MapView, T_camera_world: Floats, landmark_ids: Ints) -> float:
    """Median distance in metres of landmarks ``(N,)``, -1 for none, from a camera; 0 where there are none."""
    points_w = map_.landmarks.position_w[landmark_ids[landmark_ids >= 0]]
    if len(points_w) == 0:
        return 0.0
    return float(np.median(np.linalg.norm(points_w - invert(T_camera_world)[:3, 3], axis=1)))


def depths_in_both(
    first: tuple[MapView, Floats, Ints], second: tuple[MapView, Floats, Ints]
) -> tuple[Floats, Floats]:
    """Depths of what a camera sees twice, as landmarks of one place and of another, metres of each.

    Args:
        first, second: map, ``T_camera_world (4, 4)`` in it, and landmarks ``(N,)`` of the same features.

    Returns:
        ``(M,)`` each, of the features whose landmarks are in front of the camera in both.
    """
    a, b = (
        transform(T_camera_world, map_.landmarks.position_w[ids])[:, 2]
        for map_, T_camera_world, ids in (first, second)
    )
    ok = (a > NEAREST_M) & (b > NEAREST_M)
    return a[ok], b[ok]


def fits(view: View, place: Place, min_inliers: int) -> bool:
    """Whether an image fits some place of a map; ``min_inliers`` landmarks must agree."""
    answers = place.places.query_vector(view.words, top_k=_TRIED)
    placements = (place.place_view(view.features, k) for k, _ in answers)
    return any(found is not None and found.inliers >= min_inliers for found in placements)


def fits_elsewhere(
    view: View,
    place: Place,
    distance_m: float,
    min_inliers: int,
    *,
    newest: int | None = None,
    reach: Reach | None = None,
) -> bool:
    """Whether an image fits a map in another place than where it is said to be.

    Args:
        distance_m: median distance of what it sees, in metres of that map.
        min_inliers: landmarks that must agree.
        newest: id of the last keyframe that is compared; None compares all.
        reach: another place counts only within reach; None counts all.
    """
    ids = view.landmark_ids
    shared = None if ids is None else place.map.shared_landmarks(ids)
    others = [
        k
        for k, _ in place.places.query_vector(view.words, top_k=len(place.places))
        if (newest is None or k <= newest) and (shared is None or shared[k] < ALREADY_LINKED)
    ]
    for k in others[:_TRIED]:
        placement = place.place_view(view.features, k)
        if placement is None or placement.inliers < min_inliers:
            continue
        D = placement.T_camera_world @ invert(view.T_camera_world)
        turned, shifted_m = float(rotation_angle_rad(D[:3, :3])), float(np.linalg.norm(D[:3, 3]))
        is_elsewhere = turned > _ELSEWHERE[0] or shifted_m > _ELSEWHERE[1] * distance_m
        if is_elsewhere and (reach is None or reach.includes(placement.T_camera_world)):
            return True
    return False
