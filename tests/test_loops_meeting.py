# SPDX-License-Identifier: Apache-2.0
"""Keyframes that see a place of another map: the similarity they give, and when they are believed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from growing_map import add_keyframe, flat_depth

from slamdepth.geometry import Similarity, invert, se3_exp, transform
from slamdepth.loops.meeting import Meeting, Meetings, find_meeting
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.mapping.map import Map
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.mapping.placement import Placement
from slamdepth.typing import Floats

OTHER_HOME = Similarity(1.4, se3_exp(np.array([0.3, -1.0, 2.0, 0.2, -0.4, 0.1])))
"""From the map that the camera is in to the other one."""


def two_maps(count: int = 6) -> tuple[Map, Map]:
    """A walk of ``count`` keyframes in each, the same one by :data:`OTHER_HOME`."""
    home, other = Map(), Map()
    for n in range(count):
        T_home_camera = se3_exp(np.array([0.2 * n, 0.01 * n, -0.05 * n, 0.0, 0.03 * n, 0.0]))
        add_keyframe(home, 4, invert(T_home_camera))
        add_keyframe(other, 4, invert(OTHER_HOME.camera(T_home_camera)))
    return home, other


def meeting(home: Map, other: Map, n: int, error: Floats | None = None, scale: float = 1.4) -> Meeting:
    """Keyframe ``n`` sees the place of the other map's keyframe ``n - 1``, ``error (6,)`` off."""
    T_camera_other = other.keyframes[n].T_camera_world
    if error is not None:
        T_camera_other = se3_exp(error) @ T_camera_other
    pose = AnchoredPose.of(T_camera_other, other.keyframes[max(n - 1, 0)])
    return Meeting(home.keyframes[n], 1.0, pose, np.zeros(4, np.int64), scale, distance_m=3.0)


def test_a_meeting_says_how_the_maps_lie_to_one_another() -> None:
    home, other = two_maps()
    found = meeting(home, other, 3).similarity
    assert found.scale == pytest.approx(1.4)
    np.testing.assert_allclose(found.T_a_b, OTHER_HOME.T_a_b, atol=1e-12)


def test_a_meeting_follows_both_maps() -> None:
    home, other = two_maps()
    seen = meeting(home, other, 3)
    home.move(Similarity(2.0, se3_exp(np.full(6, 0.3))))
    other.move(Similarity(0.5, se3_exp(np.full(6, -0.2))))
    found = seen.similarity
    for k in range(6):
        np.testing.assert_allclose(
            found.camera(home.keyframes[k].T_world_camera), other.keyframes[k].T_world_camera, atol=1e-12
        )
    assert found.scale == pytest.approx(1.4 * 0.5 / 2.0)


def test_a_meeting_is_a_loop_once_the_maps_are_one() -> None:
    home, other = two_maps()
    seen = meeting(home, other, 3)
    home.move(seen.similarity)
    other.absorb(home)
    edge = seen.edge((0.01, 0.02, 0.03))
    assert (edge.i, edge.j, edge.is_loop) == (2, 9, True)
    assert edge.scale_i_j == pytest.approx(1.0)
    T_2_9 = other.keyframes[2].T_camera_world @ other.keyframes[9].T_world_camera
    np.testing.assert_allclose(edge.T_i_j, T_2_9, atol=1e-12)


def test_three_keyframes_that_agree_are_believed() -> None:
    home, other = two_maps()
    meetings = Meetings()
    seen = [meeting(home, other, n) for n in (1, 2, 4)]
    assert [meetings.add(m) for m in seen] == [[], [], seen]


@pytest.mark.parametrize(
    ("error", "scale"),
    [
        (np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), 1.4),  # of a distance of three metres
        (np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]), 1.4),
        (np.zeros(6), 2.1),
    ],
    ids=["shifted", "turned", "scaled"],
)
def test_keyframes_that_contradict_one_another_are_not(error: Floats, scale: float) -> None:
    """Three keyframes see look-alikes of a place, each elsewhere: no two say the same."""
    home, other = two_maps()
    meetings = Meetings()
    seen = [meeting(home, other, n, k * error, scale**k * 1.4 ** (1 - k)) for k, n in enumerate((1, 2, 3))]
    assert [meetings.add(m) for m in seen] == [[], [], []]
    honest = [meeting(home, other, n) for n in (4, 5)]
    assert [len(meetings.add(m)) for m in honest] == [0, 3]  # with the first, which was right


class Fits:
    """A map whose keyframes all look alike."""

    def __init__(self, map_: Map) -> None:
        self.map = map_
        self.places = PlaceRecogniser()
        for keyframe in map_.keyframes:
            self.places.add(keyframe.id, np.full((40, 32), 7, np.uint8))

    def place_view(self, features: Any, candidate: int) -> Placement | None:
        raise NotImplementedError


def maps_with_landmarks() -> tuple[Map, Map]:
    """:func:`two_maps`, each keyframe with twelve landmarks of its own, two to four metres away."""
    rng = np.random.default_rng(1)
    points_c = np.column_stack([rng.uniform(-1, 1, (12, 2)), rng.uniform(2, 4, 12)])
    home, other = Map(), Map()
    for n in range(6):
        T_home_camera = se3_exp(np.array([0.2 * n, 0.0, 0.0, 0.0, 0.03 * n, 0.0]))
        for map_, T_world_camera, scale in (
            (home, T_home_camera, 1.0),
            (other, OTHER_HOME.camera(T_home_camera), 1.4),
        ):
            keyframe = add_keyframe(map_, 12, invert(T_world_camera))
            position_w = transform(T_world_camera, scale * points_c)
            map_.create_landmarks(keyframe, np.arange(12), position_w, np.tile(1e-4 * np.eye(3), (12, 1, 1)))
            map_.set_depth(keyframe, flat_depth(), np.zeros(12), np.ones(12))
    return home, other


def sees_own(map_: Map, n: int) -> Placement:
    return Placement(map_.keyframes[n].T_camera_world, map_.keyframes[n].landmark_ids)


@pytest.mark.parametrize("alike", ["nowhere", "in the other map", "at home", "the place itself"])
def test_a_place_counts_only_where_nothing_looks_like_it(alike: str, monkeypatch: pytest.MonkeyPatch) -> None:
    home, other = maps_with_landmarks()
    elsewhere = se3_exp(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))

    class Other(Fits):
        def place_view(self, features: Any, candidate: int) -> Placement | None:
            right = sees_own(other, 3)
            wrong = Placement(elsewhere @ right.T_camera_world, right.landmark_ids)
            if features is other.keyframes[2].features:
                return wrong if alike == "the place itself" and candidate == 5 else None
            if candidate == 2:
                return right
            return wrong if alike == "in the other map" and candidate == 4 else None

    class Home(Fits):
        def place_view(self, features: Any, candidate: int) -> Placement | None:
            found = sees_own(home, 3)
            return (
                Placement(elsewhere @ found.T_camera_world, found.landmark_ids)
                if alike == "at home"
                else None
            )

    places = Other(other)
    monkeypatch.setattr(places.places, "query_vector", lambda *_, **__: [(k, 1.0) for k in (2, 4, 5)])
    found = find_meeting(home.keyframes[3], Home(home), places, min_inliers=8)
    assert (found is not None) == (alike == "nowhere")
    if found is not None:
        assert found.similarity.scale == pytest.approx(1.4)
        np.testing.assert_allclose(found.similarity.T_a_b, OTHER_HOME.T_a_b, atol=1e-9)
