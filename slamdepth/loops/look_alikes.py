# SPDX-License-Identifier: Apache-2.0
"""Places that look alike: whether a view fits a map in more than one place.

Verification by geometry cannot tell two equal desks from one another. That a map has such places it can tell:
a view then fits elsewhere as well, by the same verification.
"""

from __future__ import annotations

from typing import Protocol

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

    def place_keyframe(self, keyframe: MapKeyframe, candidate: int) -> Placement | None:
        """Place a keyframe of any map by matching it with the keyframe ``candidate`` of this map."""
        ...


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


def fits_elsewhere(
    keyframe: MapKeyframe,
    words: Floats32,
    place: Place,
    T_camera_world: Floats,
    distance_m: float,
    min_inliers: int,
    newest: int | None = None,
) -> bool:
    """Whether a keyframe fits a map in another place than where it is said to be.

    Args:
        words: place vector ``(W,)`` of the keyframe.
        T_camera_world: ``(4, 4)`` where it is said to be in that map.
        distance_m: median distance of what it sees, in metres of that map.
        min_inliers: landmarks that must agree.
        newest: id of the last keyframe that is compared; None compares all.
    """
    is_own = keyframe.id < len(place.map.keyframes) and place.map.keyframes[keyframe.id] is keyframe
    shared = place.map.shared_landmarks(keyframe.landmark_ids) if is_own else None
    others = [
        k
        for k, _ in place.places.query_vector(words, top_k=len(place.places))
        if (newest is None or k <= newest)
        and (shared is None or (k != keyframe.id and shared[k] < ALREADY_LINKED))
    ]
    for k in others[:_TRIED]:
        placement = place.place_keyframe(keyframe, k)
        if placement is None or placement.inliers < min_inliers:
            continue
        D = placement.T_camera_world @ invert(T_camera_world)
        turned, shifted_m = float(rotation_angle_rad(D[:3, :3])), float(np.linalg.norm(D[:3, 3]))
        if turned > _ELSEWHERE[0] or shifted_m > _ELSEWHERE[1] * distance_m:
            return True
    return False
