# SPDX-License-Identifier: Apache-2.0
"""Loops on trial in an exact world: what the map's own observations say of a correction."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from growing_map import check
from ring_world import TURN, World, true_pose

from slamdepth.backend.pose_graph import Edge, PoseGraphResult, optimise_pose_graph
from slamdepth.config import Config
from slamdepth.geometry import se3_exp
from slamdepth.loops.edges import odometry_edges
from slamdepth.loops.meeting import Meeting
from slamdepth.loops.trial import part_between
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.typing import Floats, Ints


def believing(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the pose graph believe every loop: a wrong one has slipped through every other gate."""

    def believed(T_old: Floats, together: Ints, new: list[Edge], looser: float = 1.0) -> PoseGraphResult:
        edges = [*odometry_edges(world.map, together), *(replace(edge, is_loop=False) for edge in new)]
        return optimise_pose_graph(T_old, edges, with_scale=not world.map.is_measured)

    monkeypatch.setattr(world.closer, "_optimised", believed)


def state(world: World) -> dict[str, np.ndarray]:
    """Everything that a correction of the map would change."""
    landmarks = {
        field.name: getattr(world.map.landmarks, field.name) for field in fields(world.map.landmarks)
    }
    seen = {f"seen {k.id}": k.landmark_ids for k in world.map.keyframes}
    depths = {f"depth {k.id}": k.log_depth for k in world.map.keyframes}
    poses = {"poses": world.map.T_world_camera, "units": world.map.units}
    return {name: np.array(value) for name, value in {**landmarks, **seen, **depths, **poses}.items()}


@pytest.mark.parametrize("is_sensor", [True, False])
def test_a_true_loop_that_closes_a_drift_stays(is_sensor: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(TURN - 1, turn_drift=0.005, scale_drift=0.0 if is_sensor else 0.006, is_sensor=is_sensor)
    believing(world, monkeypatch)
    assert any(world.grow() is not None for _ in range(5))
    assert (world.closer.count, world.closer.taken_back) == (1, 0)
    assert world.turn_errors_rad().max() < 0.02


@pytest.mark.parametrize("aside_deg", [60.0, 120.0])
@pytest.mark.parametrize("is_sensor", [True, False])
def test_a_wrong_loop_that_every_gate_believes_is_taken_back_and_leaves_the_map_as_it_was(
    is_sensor: bool, aside_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Furniture seen again from where it is not; tracked points hold each keyframe to the next."""
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(aside_deg), 0.0]))
    seen_from = {k: aside @ true_pose(k) for k in range(TURN - 3, TURN + 3)}
    with_loops, without = (World(TURN - 3, is_sensor=is_sensor, seen_from=seen_from) for _ in range(2))
    believing(with_loops, monkeypatch)
    without.closer._config = Config.from_dict({"loops": {"enabled": False}})
    for world in (with_loops, without):
        for _ in range(2):  # the keyframe after them sees the first one in truth
            world.grow()
    assert with_loops.closer.count == 0
    assert with_loops.closer.taken_back >= 1
    assert with_loops.closer.refused >= with_loops.closer.taken_back
    ours, theirs = state(with_loops), state(without)
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], name)
    check(with_loops.map)


def two_worlds(is_sensor: bool) -> tuple[World, World]:
    """Two maps of the same part of the ring."""
    return World(6, is_sensor=is_sensor), World(6, is_sensor=is_sensor)


def meeting(home: World, other: World, k: int) -> Meeting:
    """Keyframe ``k`` sees the place of the other map's keyframe ``k``."""
    keyframe, place = home.map.keyframes[k], other.map.keyframes[k]
    pose = AnchoredPose.of(place.T_camera_world, place)
    return Meeting(keyframe, 1.0, pose, place.landmark_ids, 1.0, distance_m=3.0)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_maps_join_where_their_meetings_reproject_in_one_map(is_sensor: bool) -> None:
    home, other = two_worlds(is_sensor)
    meetings = [meeting(home, other, k) for k in (2, 3, 4)]
    assert home.closer.may_join(other.map, meetings, meetings[0].similarity)
    assert (home.closer.refused, home.closer.taken_back) == (0, 0)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_a_join_is_taken_back_where_the_maps_do_not_reproject_as_one(is_sensor: bool) -> None:
    """They agree on a similarity, but what they say to see is not where they see it."""
    home, other = two_worlds(is_sensor)
    wrong = [meeting(home, other, k) for k in (2, 3, 4)]
    wrong = [replace(one, landmark_ids=np.roll(one.landmark_ids, 7)) for one in wrong]
    before = state(other)
    assert not home.closer.may_join(other.map, wrong, wrong[0].similarity)
    assert (home.closer.refused, home.closer.taken_back) == (1, 1)
    for name, value in state(other).items():
        np.testing.assert_array_equal(value, before[name], name)


def test_a_part_has_its_ends_and_is_thinned_out_where_it_is_long() -> None:
    world = World(12, is_sensor=True)
    assert list(part_between(world.map, 5, 9).keyframe_ids) == [2, 3, 4, 5, 6, 7, 8, 9]
    assert list(part_between(world.map, 0, 11).keyframe_ids) == list(range(12))
