# SPDX-License-Identifier: Apache-2.0
"""Closing loops in an exact world: a camera turns in a ring of points until it sees the first ones again."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from growing_map import check
from ring_world import BLANK, CAMERA, CONFIG, TURN, World, true_pose
from tracking_scene import CONFIG as WALK_CONFIG
from tracking_scene import Run, frames

from slamdepth.backend.pose_graph import Edge
from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import invert, rotation_angle_rad, se3_exp
from slamdepth.loops.consistency import Drift, RefusedLoops
from slamdepth.loops.edges import odometry_edges, weakness
from slamdepth.mapping.map import MapKeyframe
from slamdepth.mapping.placement import Placement
from slamdepth.types import Frame
from slamdepth.typing import Floats


def grown_until_a_loop(**drift: Any) -> World:
    world = World(TURN - 1, **drift)
    for _ in range(5):
        if world.grow() is not None:
            return world
    raise AssertionError("no loop was found")


def test_a_turn_that_drifted_is_closed() -> None:
    drifted = World(TURN - 1, turn_drift=0.005, scale_drift=0.0, is_sensor=True)
    assert drifted.turn_errors_rad()[-1] > 0.07
    world = grown_until_a_loop(turn_drift=0.005, scale_drift=0.0, is_sensor=True)
    assert world.closer.count == 1
    assert world.turn_errors_rad().max() < 0.02
    np.testing.assert_allclose(world.map.keyframes[0].T_camera_world, np.eye(4), atol=1e-3)
    np.testing.assert_array_equal(world.closures[0][1].scales, 1.0)
    check(world.map)
    last = world.map.keyframes[-1]
    old = last.landmark_ids[last.landmark_ids >= 0]
    assert (world.map.landmarks.anchor_keyframe[old] <= 3).sum() >= CONFIG.loops.min_inliers  # one map again


def test_a_drift_of_scale_is_closed() -> None:
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    assert world.closer.count == 1
    scales = np.array([k.scale for k in world.map.keyframes])
    assert scales[-1] == pytest.approx(scales[0], rel=0.04)  # it was 1.10
    correction = world.closures[0][1].scales
    assert correction[-1] < 0.95
    assert correction[0] == pytest.approx(1.0, abs=1e-3)


def test_a_large_drift_is_closed_once_three_keyframes_agree() -> None:
    """Nine degrees and a quarter of a metre, and predicted depth 1.2 times too large by then."""
    steps = TURN - 1
    drift: dict[str, Any] = {
        "turn_drift": np.deg2rad(9.0) / steps,
        "shift_drift_m": 0.25 / steps,
        "scale_drift": 1.2 ** (1 / steps) - 1.0,
        "is_sensor": False,
    }
    drifted = World(TURN, **drift)
    assert drifted.closer.count == 0  # one keyframe alone is not believed
    assert drifted.turn_errors_rad()[-1] > np.deg2rad(8.5)
    world = grown_until_a_loop(**drift)
    assert world.closures[0][0] == TURN + 1
    assert world.closer.count == 1
    assert world.turn_errors_rad().max() < np.deg2rad(2.0)
    assert world.position_errors_m().max() < 0.05
    np.testing.assert_allclose([k.scale for k in world.map.keyframes], 1.0, atol=0.06)
    check(world.map)


@pytest.mark.parametrize(("is_sensor", "turn_deg"), [(True, 12.0), (False, 20.0)])
def test_a_break_where_nothing_was_tracked_is_closed_once_three_keyframes_agree(
    is_sensor: bool, turn_deg: float
) -> None:
    """Odometry turns too far at one step without a landmark, and is right before and after."""
    world = World(TURN - 3, is_sensor=is_sensor, alone=True, astray={TURN - 4: np.deg2rad(turn_deg)})
    for _ in range(8):
        world.grow()
    assert world.closures[0][0] >= TURN + 1  # one or two keyframes alone are not believed
    assert world.turn_errors_rad().max() < np.deg2rad(4.0)
    check(world.map)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_loops_that_contradict_odometry_and_one_another_are_refused(is_sensor: bool) -> None:
    """A can with two like sides: each keyframe sees another place, and not where the one before saw it."""
    wrong = {k: np.deg2rad(10.0) for k in range(TURN - 1, TURN + 9)}
    world = World(TURN + 8, is_sensor=is_sensor, astray=wrong)
    assert world.closer.count == 0


@pytest.mark.parametrize("is_sensor", [True, False])
def test_identical_desks_are_not_joined_however_many_keyframes_agree(is_sensor: bool) -> None:
    """Two metres apart over 60 keyframes of good odometry: agreement alone is no evidence."""
    T = np.tile(np.eye(4), (100, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(100)
    refused = RefusedLoops()
    drift = Drift(T, np.ones(99), is_sensor)
    for n in range(12):
        seen = invert(T[n]) @ T[60 + n]
        seen[0, 3] -= 2.0
        edge = Edge(n, 60 + n, seen, is_loop=True)
        assert refused.confirmed(edge, drift) == []
        refused.add(edge, drift)


def test_false_loops_of_a_keyframe_do_not_push_out_the_true_one() -> None:
    """Of identical desks the false one is often verified first."""
    T = np.tile(np.eye(4), (70, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(70)
    refused, drift = RefusedLoops(), Drift(T, np.ones(69), is_measured=False)
    confirmed: list[Edge] = []
    for n in range(3):
        for off_m in (-2.5, 0.6):  # the other desk; the true place, after a drift
            seen = invert(T[n]) @ T[60 + n]
            seen[0, 3] += off_m
            edge = Edge(n, 60 + n, seen, is_loop=True)
            confirmed = refused.confirmed(edge, drift)
            refused.add(edge, drift)
    assert [edge.j for edge in confirmed] == [60, 61, 62]
    np.testing.assert_allclose([edge.T_i_j[0, 3] for edge in confirmed], 6.6)


def test_odometry_drifts_more_over_weak_steps_and_less_with_a_sensor() -> None:
    T = np.tile(np.eye(4), (11, 1, 1))
    usual, weak = weakness(np.array([400, 60])), weakness(np.array([15, 3, 0]))
    np.testing.assert_allclose(usual, 1.0)
    np.testing.assert_allclose(weak, [4.0, 20.0, 20.0])
    strong = Drift(T, np.ones(10), is_measured=False).bounds(10)[0]
    measured = Drift(T, np.ones(10), is_measured=True).bounds(10)[0]
    broken = Drift(T, np.r_[np.ones(9), 20.0], is_measured=False).bounds(10)[0]
    np.testing.assert_allclose(measured, 0.5 * strong)
    assert all(b > 4.0 * s for b, s in zip(broken[:2], strong[:2], strict=True))


@pytest.mark.parametrize("is_sensor", [True, False])
def test_a_place_is_found_where_odometry_allows_it_though_others_look_more_alike(is_sensor: bool) -> None:
    """Identical desks fill the first ranks of a query by appearance."""
    world = World(TURN - 1, turn_drift=0.003, is_sensor=is_sensor, alone=True)
    query = world.closer.places.query_keyframe

    def misled(keyframe_id: int, **options: Any) -> list[tuple[int, float]]:
        return [(TURN // 2, 1.0), (TURN // 2 + 1, 1.0), *query(keyframe_id, **options)]

    world.closer.places.query_keyframe = misled  # type: ignore[method-assign]
    assert any(world.grow() is not None for _ in range(3))
    assert all(closure.candidate not in (TURN // 2, TURN // 2 + 1) for _, closure in world.closures)
    assert world.turn_errors_rad().max() < 0.02


def test_candidates_by_odometry_are_near_as_far_as_it_can_have_drifted_and_look_the_same_way() -> None:
    T = np.tile(np.eye(4), (41, 1, 1))
    T[:, 0, 3] = 0.1 * np.r_[np.arange(20), np.arange(20, -1, -1)]  # 2 m there and back
    T[10:12, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # about-face
    sensor = Drift(T, np.ones(40), is_measured=True)
    near = sensor.nearby(40, reach_m=0.5)
    assert {0, 1, 5} <= set(near.tolist())
    assert not {9, 10, 11, 18, 20} & set(near.tolist())
    assert near.max() < 40
    lost = Drift(T, np.r_[np.ones(39), 20.0], is_measured=True)  # the last step was tracked by chance
    assert 9 in lost.nearby(40, reach_m=0.5)
    np.testing.assert_array_equal(sensor.nearby(0, reach_m=0.5), [])


def offered(world: World) -> list[tuple[bool, bool]]:
    """Of each verified loop from here on: whether it is true, and whether it was accepted."""
    found: list[tuple[bool, bool]] = []
    apply = world.closer._apply

    def spy(keyframe: MapKeyframe, edge: Edge, placement: Placement, drift: Drift) -> Floats | None:
        wrong = invert(edge.T_i_j) @ invert(true_pose(edge.i)) @ true_pose(keyframe.id)
        scales = apply(keyframe, edge, placement, drift)
        is_true = rotation_angle_rad(wrong[:3, :3]) < 0.1 and np.linalg.norm(wrong[:3, 3]) < 0.2
        found.append((bool(is_true), scales is not None))
        return scales

    world.closer._apply = spy  # type: ignore[method-assign]
    return found


@pytest.mark.parametrize("turn_drift_deg", [3.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_30_percent_false_loops_are_refused(seed: int, turn_drift_deg: float) -> None:
    """Furniture of one place stands in another too: visual words agree and so does geometry, PnP included."""
    rng = np.random.default_rng(seed)
    second_turn = np.arange(TURN, 2 * TURN)
    seen_from = {}
    for k in rng.choice(second_turn, 6, replace=False):
        other = true_pose(int(k) + int(rng.integers(4, TURN - 4)))  # 80 to 280 degrees away
        seen_from[int(k)] = other @ se3_exp(rng.normal(size=6) * [0.2, 0.2, 0.2, 0.1, 0.1, 0.1])
    world = World(
        TURN, turn_drift=np.deg2rad(turn_drift_deg) / TURN, is_sensor=False, alone=True, seen_from=seen_from
    )
    loops = offered(world)
    for _ in second_turn:
        world.grow()
    false = [accepted for is_true, accepted in loops if not is_true]
    true = [accepted for is_true, accepted in loops if is_true]
    assert len(false) >= 6
    assert len(false) >= 0.3 * len(loops)
    assert not any(false)
    assert sum(true) >= 8
    assert world.turn_errors_rad()[TURN:].max() < np.deg2rad(0.15 * turn_drift_deg + 2.0)


def test_false_loops_that_agree_are_refused_where_no_drift_explains_them() -> None:
    """The same furniture seen again and again from where it cannot be."""
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(120.0), 0.0]))
    seen_from = {k: aside @ true_pose(k) for k in range(TURN - 3, TURN + 3)}
    world = World(TURN - 3, is_sensor=True, alone=True, seen_from=seen_from)
    loops = offered(world)
    for _ in range(6):
        world.grow()
    assert [is_true for is_true, _ in loops].count(False) >= 5
    assert not any(accepted for is_true, accepted in loops if not is_true)
    assert world.position_errors_m().max() < 0.01


def test_a_refused_loop_leaves_no_trace() -> None:
    """The map is that of a run without loop closing, to the last bit."""
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(120.0), 0.0]))
    seen_from = {k: aside @ true_pose(k) for k in range(TURN - 6, TURN - 1)}
    with_loops, without = (World(TURN - 6, is_sensor=True, alone=True, seen_from=seen_from) for _ in range(2))
    without.closer._config = Config.from_dict({"loops": {"enabled": False}})
    loops = offered(with_loops)
    for world in (with_loops, without):
        for _ in range(5):
            world.grow()
    assert len(loops) >= 3
    assert not any(accepted for _, accepted in loops)
    assert with_loops.closer.refused == len(loops)
    for field in fields(with_loops.map.landmarks):
        ours, theirs = (getattr(world.map.landmarks, field.name) for world in (with_loops, without))
        np.testing.assert_array_equal(ours, theirs, field.name)


def test_a_kept_loop_follows_the_metres_of_its_keyframes() -> None:
    """A loop whose correction was applied must not ask for it again."""
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    (loop,) = world.closer._loops
    assert loop.edge.scale_i_j < 0.95  # as it was measured: 0.90
    assert loop.in_units(world.map.units).scale_i_j == pytest.approx(1.0, abs=0.04)


def test_a_second_loop_does_not_repeat_the_first_correction() -> None:
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    first_turn = np.array([k.scale for k in world.map.keyframes])
    world._ids = {}  # nothing is recognised for a turn
    world.closer._config = Config.from_dict({"loops": {"enabled": False}})
    for _ in range(TURN - 1):
        world.grow()
    world.closer._config = CONFIG
    assert any(world.grow() is not None for _ in range(5))
    assert np.abs(np.log(world.closures[-1][1].scales)).max() > 0.02  # it corrected the map
    after = np.array([k.scale for k in world.map.keyframes])
    np.testing.assert_allclose(after[: len(first_turn)], first_turn, rtol=0.03)
    np.testing.assert_allclose(after, 1.0, rtol=0.06)


@pytest.mark.parametrize("seed", range(3))
def test_landmarks_keep_their_place_in_their_anchor_keyframe(seed: int) -> None:
    """A correction is a similarity for every keyframe and the landmarks that it created."""
    world = World(5, turn_drift=0.0, scale_drift=0.0, is_sensor=False)
    map_, landmarks = world.map, world.map.landmarks
    rng = np.random.default_rng(seed)
    anchor = landmarks.anchor_keyframe
    T_old = map_.T_world_camera
    T_new = T_old @ se3_exp(0.1 * rng.normal(size=(5, 6)))
    scales = np.exp(0.2 * rng.normal(size=5))
    logs = [k.log_depth.copy() for k in map_.keyframes]
    T_camera_old = invert(T_old)[anchor]
    before = np.einsum("nij,nj->ni", T_camera_old[:, :3, :3], landmarks.position_w) + T_camera_old[:, :3, 3]
    R = T_camera_old[:, :3, :3]
    covariance = R @ landmarks.covariance_w @ np.swapaxes(R, 1, 2)
    map_.correct_similarities(T_new, scales)
    np.testing.assert_allclose(map_.T_world_camera, T_new, atol=1e-12)
    T_camera_new = invert(T_new)[anchor]
    after = np.einsum("nij,nj->ni", T_camera_new[:, :3, :3], landmarks.position_w) + T_camera_new[:, :3, 3]
    np.testing.assert_allclose(after, before * scales[anchor][:, None], atol=1e-12)
    R = T_camera_new[:, :3, :3]
    np.testing.assert_allclose(
        R @ landmarks.covariance_w @ np.swapaxes(R, 1, 2),
        covariance * (scales[anchor] ** 2)[:, None, None],
        atol=1e-12,
    )
    np.testing.assert_allclose(landmarks.distance_m, np.linalg.norm(after, axis=1))
    for k, keyframe in enumerate(map_.keyframes):
        np.testing.assert_allclose(keyframe.log_depth, logs[k] + np.log(scales[k]))
        assert keyframe.scale == pytest.approx(scales[k])


def test_no_loop_where_nothing_is_seen_twice() -> None:
    world = World(TURN - 4, turn_drift=0.01, scale_drift=0.0, is_sensor=True)
    assert world.closer.count == 0
    check(world.map)


def test_no_loop_between_two_places_that_only_look_alike() -> None:
    """The same descriptors in another arrangement: visual words agree, geometry does not."""
    world = World(TURN - 3, turn_drift=0.0, scale_drift=0.0, is_sensor=True)
    keyframe = world.map.keyframes[-1]
    first = world.map.keyframes[0].features
    rng = np.random.default_rng(5)
    n = len(first)
    px = rng.uniform((5, 5), (635, 475), (n, 2))
    fake = Features(px, px, first.octave, first.sigma_px, first.descriptors)
    nothing_seen = np.full(n, -1, dtype=np.int64)
    impostor = world.map.add_keyframe(
        Frame(99, 99.0, BLANK, CAMERA), fake, keyframe.T_camera_world, nothing_seen
    )
    assert keyframe.prediction is not None
    unknown = np.full(n, np.nan)
    world.map.set_depth(impostor, keyframe.prediction.load(), unknown, unknown)
    poses = world.map.T_world_camera
    assert world.closer.close(impostor, world.closer.describe(fake)) is None
    assert world.closer.candidates(impostor, world.closer.drift())[0][:1] == [0]
    np.testing.assert_array_equal(world.map.T_world_camera, poses)


def test_a_keyframe_is_tied_to_those_it_shares_most_with_and_no_others() -> None:
    """Walking through one room for hours would otherwise tie each keyframe to every other."""
    world = World(3 * TURN, is_sensor=True)
    edges = odometry_edges(world.map, world.map.covisibility())
    together = world.map.covisibility()
    for j in range(1, len(together)):
        partners = [edge.i for edge in edges if edge.j == j]
        others = np.setdiff1d(np.arange(j - 1), partners)
        assert partners == sorted({j - 1, *partners})
        assert len(partners) <= 11
        assert all(together[j, i] >= 80 for i in partners[:-1])
        if len(others) and len(partners) > 1:
            assert together[j, others].max() <= max(together[j, partners[:-1]].min(), 79)
    assert max(sum(edge.j == j for edge in edges) for j in range(len(together))) == 10


def test_loops_can_be_switched_off() -> None:
    world = World(3, turn_drift=0.0, scale_drift=0.0, is_sensor=True)
    world.closer._config = Config.from_dict({"loops": {"enabled": False}})
    for _ in range(TURN):
        assert world.grow() is None
    assert world.closer.count == 0


def test_no_loop_on_a_walk_that_never_returns() -> None:
    config = WALK_CONFIG.model_copy(update={"loops": CONFIG.loops})
    made = Run(frames(range(0, 30)), config=config).finish()
    assert made.statistics.loop_closures == 0
