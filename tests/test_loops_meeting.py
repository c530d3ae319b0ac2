# SPDX-License-Identifier: Apache-2.0
"""Keyframes that see a place of another map: the similarity they give, and when they are believed."""

from __future__ import annotations

import numpy as np
import pytest
from growing_map import add_keyframe

from slamdepth.geometry import Similarity, invert, se3_exp
from slamdepth.loops.meeting import Meeting, Meetings
from slamdepth.mapping.map import Map
from slamdepth.mapping.map_keyframe import AnchoredPose
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
