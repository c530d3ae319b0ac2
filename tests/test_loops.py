# SPDX-License-Identifier: Apache-2.0
"""Closing loops in an exact world: a ring of points round a camera that turns, and comes back."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from tracking_scene import CONFIG as WALK_CONFIG
from tracking_scene import Run, frames

from slamdepth.backend.pose_graph import Edge
from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, so3_exp, transform
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.localiser import Localiser, Placement
from slamdepth.tracking.loop_closer import Correction, LoopCloser
from slamdepth.tracking.refused_loops import RefusedLoops
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
CONFIG = Config.from_dict({"loops": {"min_gap": 5}})
TURN = 18  # keyframes in a full turn
BLANK = np.zeros((480, 640, 3), np.uint8)


@lru_cache(maxsize=1)
def ring() -> tuple[np.ndarray, np.ndarray]:
    """Points ``(N, 3)`` on walls all round, and a descriptor for each."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(2.0, 4.0, 3000)
    X = np.stack([radius * np.sin(angle), rng.uniform(-1.2, 1.2, 3000), radius * np.cos(angle)], axis=1)
    return X, rng.integers(0, 256, (3000, 32), dtype=np.uint8)


def true_pose(k: int) -> np.ndarray:
    """``T_world_camera`` on a small circle, looking outwards."""
    angle = 2 * np.pi * k / TURN
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([0.0, angle, 0.0]))
    T[:3, 3] = 0.4 * np.array([np.sin(angle), 0.1 * np.sin(2 * angle), np.cos(angle) - 1.0])
    return T


def view(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which points of the ring are seen from there, at which pixels ``(N, 2)`` and depths in metres."""
    px, z = project(CAMERA, transform(invert(T_world_camera), ring()[0]))
    seen = np.flatnonzero((z > 0.3) & (px > 5).all(1) & (px[:, 0] < 635) & (px[:, 1] < 475))
    return seen, px[seen], z[seen]


class World:
    """A map grown along the circle with a drift of pose and scale; metric if ``is_sensor``.

    Args:
        turn_drift, shift_drift_m, scale_drift: radians, metres and share of the scale lost each step.
        alone: no point is followed from one keyframe to the next, so that each looks for loops.
        seen_from: keyframes that see, beside their own place, another one's furniture as from this pose.
        astray: keyframes before which odometry turns wrongly by ten degrees each; before the first of them
            no point is followed.
    """

    def __init__(
        self,
        count: int,
        *,
        turn_drift: float = 0.0,
        shift_drift_m: float = 0.0,
        scale_drift: float = 0.0,
        is_sensor: bool,
        alone: bool = False,
        seen_from: dict[int, np.ndarray] | None = None,
        astray: range = range(0),
    ) -> None:
        self.map = LandmarkMap()
        self.closer = LoopCloser(CONFIG, self.map, Localiser(CAMERA, CONFIG, self.map))
        self._rows: dict[int, int] = {}  # of the points tracked at present
        self._turn_drift, self._scale_drift, self._is_sensor = turn_drift, scale_drift, is_sensor
        self._shift_drift_m, self._alone, self._seen_from = shift_drift_m, alone, seen_from or {}
        self._astray = astray
        self.corrections: list[tuple[int, Correction]] = []
        self._pose = np.eye(4)
        for _ in range(count):
            self.grow()

    def grow(self) -> Correction | None:
        k = len(self.map.keyframes)
        scale = self.map.keyframes[-1].scale * (1.0 + self._scale_drift) if k else 1.0
        if k:
            step = invert(true_pose(k - 1)) @ true_pose(k)
            step[:3, 3] *= scale
            wrongly = np.deg2rad(10.0) if k in self._astray else 0.0
            drift = so3_exp(np.array([0.0, self._turn_drift + wrongly, 0.0]))
            step[:3, :3] = step[:3, :3] @ drift
            step[1, 3] += self._shift_drift_m
            self._pose = self.map.keyframes[-1].T_world_camera @ step
        if k in self._astray[:1]:
            self._rows = {}
        descriptors = ring()[1]
        seen, px, z = view(true_pose(k))
        own = np.ones(len(seen), dtype=bool)
        if k in self._seen_from:  # a third is left of the true place, and none of it is known by sight
            other, other_px, other_z = view(self._seen_from[k])
            kept = slice(None, None, 3)
            seen, px = np.r_[seen[kept], other], np.concatenate([px[kept], other_px])
            own = np.arange(len(seen)) < len(z[kept])
            z = np.r_[z[kept], other_z]
        n = len(seen)
        features = Features(px, px, np.zeros(n, np.int64), np.ones(n), descriptors[seen])
        keyframe = MapKeyframe(
            id=k,
            frame=StoredFrame(Frame(k, float(k), BLANK, CAMERA)),
            features=features,
            T_camera_world=invert(self._pose),
            point_ids=np.array(
                [self._rows.get(int(i), -1) if o else -1 for i, o in zip(seen, own, strict=True)],
                dtype=np.int64,
            ),
            log_depth=np.log(z * scale),
            sigma_log=np.full(n, 0.02),
            prediction=StoredPrediction(
                DepthPrediction(
                    np.zeros((480, 640), np.float32), DepthKind.METRIC, None, is_sensor=self._is_sensor
                )
            ),
            scale=scale,
        )
        self.map.add_keyframe(keyframe)
        free = np.flatnonzero(keyframe.point_ids < 0)
        position = transform(self._pose, backproject(CAMERA, px[free], z[free] * scale))
        rows = self.map.add_points(keyframe, free, position, np.tile(1e-4 * np.eye(3), (len(free), 1, 1)))
        assert len(rows) == len(free)
        seen = seen[own]
        self._follow(seen, keyframe.point_ids[own])
        self.closer.add(keyframe, self.closer.describe(features))
        correction = self.closer.close(keyframe)
        if correction is not None:
            self.corrections.append((k, correction))
            self._follow(seen, keyframe.point_ids[own])
        return correction

    def _follow(self, seen: np.ndarray, rows: np.ndarray) -> None:
        known = zip(seen.tolist(), rows.tolist(), strict=True)
        self._rows = {} if self._alone else {i: row for i, row in known if row >= 0}

    def position_errors_m(self) -> np.ndarray:
        estimate = np.stack([k.T_world_camera for k in self.map.keyframes])[:, :3, 3]
        truth = np.stack([true_pose(k) for k in range(len(estimate))])[:, :3, 3]
        return np.linalg.norm(estimate - truth, axis=1)

    def turn_errors_rad(self) -> np.ndarray:
        estimate = np.stack([k.T_world_camera for k in self.map.keyframes])
        truth = np.stack([true_pose(k) for k in range(len(estimate))])
        return rotation_angle_rad((invert(estimate) @ truth)[:, :3, :3])


def recount_is_right(landmarks: LandmarkMap) -> None:
    counts = np.zeros(landmarks.size, dtype=np.int64)
    for k in landmarks.keyframes:
        seen = k.point_ids[k.point_ids >= 0]
        assert len(np.unique(seen)) == len(seen)
        np.add.at(counts, seen, 1)
    alive = landmarks.alive[: landmarks.size]
    np.testing.assert_array_equal(landmarks.observations[: landmarks.size][alive], counts[alive])
    assert (counts[~alive] == 0).all()


def grown_until_a_loop(**drift: float | bool) -> World:
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
    np.testing.assert_array_equal(world.corrections[0][1].scales, 1.0)
    recount_is_right(world.map)
    last = world.map.keyframes[-1]
    old = last.point_ids[last.point_ids >= 0]
    assert (world.map.birth_keyframe[old] <= 3).sum() >= CONFIG.loops.min_inliers  # one map again


def test_a_drift_of_scale_is_closed() -> None:
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    assert world.closer.count == 1
    scales = np.array([k.scale for k in world.map.keyframes])
    assert scales[-1] == pytest.approx(scales[0], rel=0.04)  # it was 1.10
    correction = world.corrections[0][1].scales
    assert correction[-1] < 0.95
    assert correction[0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_a_large_drift_is_closed_once_three_keyframes_agree(is_sensor: bool) -> None:
    """20 degrees and half a metre, and predicted depth 1.3 times too large by then."""
    steps = TURN - 1
    drift: dict[str, Any] = {
        "turn_drift": np.deg2rad(20.0) / steps,
        "shift_drift_m": 0.5 / steps,
        "scale_drift": 0.0 if is_sensor else 1.3 ** (1 / steps) - 1.0,
        "is_sensor": is_sensor,
    }
    drifted = World(TURN, **drift)
    assert drifted.closer.count == 0  # one keyframe alone is not believed
    assert drifted.turn_errors_rad()[-1] > np.deg2rad(19.0)
    assert drifted.position_errors_m()[-1] > 0.4
    world = grown_until_a_loop(**drift)
    assert world.corrections[0][0] == TURN + 1
    assert world.closer.count == 1
    assert world.turn_errors_rad().max() < np.deg2rad(4.0)
    assert world.position_errors_m().max() < 0.1
    scales = np.array([k.scale for k in world.map.keyframes])
    np.testing.assert_allclose(scales, 1.0, atol=1e-12 if is_sensor else 0.06)
    recount_is_right(world.map)


@pytest.mark.parametrize("is_sensor", [True, False])
def test_odometry_that_went_astray_is_not_believed_against_three_loops(is_sensor: bool) -> None:
    """Each keyframe turns by ten degrees too many, so that no two loops agree on what happened before."""
    first = TURN - 1
    world = World(TURN + 1, is_sensor=is_sensor, astray=range(first, TURN + 9))
    assert world.closer.count == 0  # two keyframes see the place of another, and are not believed
    assert world.turn_errors_rad()[-1] > np.deg2rad(19.0)
    assert world.grow() is not None
    assert world.closer.count == 1
    assert world.turn_errors_rad().max() < np.deg2rad(1.5)
    assert world.position_errors_m().max() < 0.03
    recount_is_right(world.map)


def test_loops_between_which_no_camera_could_move_do_not_insist() -> None:
    refused, still = RefusedLoops(), np.tile(np.eye(4), (40, 1, 1))
    for n, shift_m in enumerate((0.0, 5.0, 0.0)):
        T = np.eye(4)
        T[0, 3] = 2.0 + shift_m
        refused.add(Edge(n, 30 + n, T, is_loop=True))
    assert refused.insisted(still, with_scale=False) == []
    refused.forget()
    for n, turn_rad in enumerate((0.0, 0.3, 0.0)):
        refused.add(Edge(n, 30 + n, se3_exp(np.array([2.0, 0, 0, 0, turn_rad, 0])), is_loop=True))
        assert len(refused.insisted(still, with_scale=False)) == (3 if n == 2 else 0)


def offered(world: World) -> list[tuple[bool, bool]]:
    """Of each verified loop from here on: whether it is true, and whether it was accepted."""
    found: list[tuple[bool, bool]] = []
    correct = world.closer._correct

    def spy(keyframe: MapKeyframe, candidate: int, placement: Placement, scale: float) -> Correction | None:
        T_loop = world.map.keyframes[candidate].T_camera_world @ invert(placement.T_camera_world)
        wrong = invert(T_loop) @ invert(true_pose(candidate)) @ true_pose(keyframe.id)
        made = correct(keyframe, candidate, placement, scale)
        is_true = rotation_angle_rad(wrong[:3, :3]) < 0.1 and np.linalg.norm(wrong[:3, 3]) < 0.2
        found.append((bool(is_true), made is not None))
        return made

    world.closer._correct = spy  # type: ignore[method-assign]
    return found


@pytest.mark.parametrize("turn_drift_deg", [3.0, 20.0])
@pytest.mark.parametrize("seed", range(3))
def test_30_percent_false_loops_are_refused(seed: int, turn_drift_deg: float) -> None:
    """Furniture of one place stands in another too: words agree and so does geometry, through to PnP."""
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


def test_a_kept_loop_follows_the_metres_of_its_keyframes() -> None:
    """A loop that has bent the map must not ask for the same correction again."""
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    (edge,) = world.closer._edges
    assert edge.scale_i_j == pytest.approx(1.0, abs=0.04)  # 0.90 before the map was bent


def test_a_second_loop_does_not_repeat_the_first_correction() -> None:
    world = grown_until_a_loop(turn_drift=0.0, scale_drift=0.006, is_sensor=False)
    first_turn = np.array([k.scale for k in world.map.keyframes])
    world._rows = {}  # nothing is recognised for a turn
    world.closer._config = Config.from_dict({"loops": {"enabled": False}})
    for _ in range(TURN - 1):
        world.grow()
    world.closer._config = CONFIG
    assert any(world.grow() is not None for _ in range(5))
    assert np.abs(np.log(world.corrections[-1][1].scales)).max() > 0.02  # it bent the map
    after = np.array([k.scale for k in world.map.keyframes])
    np.testing.assert_allclose(after[: len(first_turn)], first_turn, rtol=0.03)
    np.testing.assert_allclose(after, 1.0, rtol=0.06)


@pytest.mark.parametrize("seed", range(3))
def test_points_keep_their_place_in_the_keyframe_of_their_birth(seed: int) -> None:
    """Bending is a similarity for every keyframe and what was born in it."""
    world = World(5, turn_drift=0.0, scale_drift=0.0, is_sensor=False)
    landmarks = world.map
    rng = np.random.default_rng(seed)
    n = landmarks.size
    birth = landmarks.birth_keyframe[:n]
    T_old = np.stack([k.T_world_camera for k in landmarks.keyframes])
    T_new = T_old @ se3_exp(0.1 * rng.normal(size=(5, 6)))
    scales = np.exp(0.2 * rng.normal(size=5))
    logs = [k.log_depth.copy() for k in landmarks.keyframes]
    T_camera_old = invert(T_old)[birth]
    before = (
        np.einsum("nij,nj->ni", T_camera_old[:, :3, :3], landmarks.position_w[:n]) + T_camera_old[:, :3, 3]
    )
    R = T_camera_old[:, :3, :3]
    covariance = R @ landmarks.covariance_w[:n] @ np.swapaxes(R, 1, 2)
    world.closer._bend(T_old, T_new, scales)
    np.testing.assert_allclose(np.stack([k.T_world_camera for k in landmarks.keyframes]), T_new, atol=1e-12)
    T_camera_new = invert(T_new)[birth]
    after = (
        np.einsum("nij,nj->ni", T_camera_new[:, :3, :3], landmarks.position_w[:n]) + T_camera_new[:, :3, 3]
    )
    np.testing.assert_allclose(after, before * scales[birth][:, None], atol=1e-12)
    R = T_camera_new[:, :3, :3]
    np.testing.assert_allclose(
        R @ landmarks.covariance_w[:n] @ np.swapaxes(R, 1, 2),
        covariance * (scales[birth] ** 2)[:, None, None],
        atol=1e-12,
    )
    np.testing.assert_allclose(landmarks.distance_m[:n], np.linalg.norm(after, axis=1))
    for k, keyframe in enumerate(landmarks.keyframes):
        np.testing.assert_allclose(keyframe.log_depth, logs[k] + np.log(scales[k]))
        assert keyframe.scale == pytest.approx(scales[k])


def test_no_loop_where_nothing_is_seen_twice() -> None:
    world = World(TURN - 4, turn_drift=0.01, scale_drift=0.0, is_sensor=True)
    assert world.closer.count == 0
    recount_is_right(world.map)


def test_no_loop_between_two_places_that_only_look_alike() -> None:
    """The same descriptors in another arrangement: words agree, geometry does not."""
    world = World(TURN - 3, turn_drift=0.0, scale_drift=0.0, is_sensor=True)
    keyframe = world.map.keyframes[-1]
    first = world.map.keyframes[0].features
    rng = np.random.default_rng(5)
    n = len(first)
    px = rng.uniform((5, 5), (635, 475), (n, 2))
    fake = Features(px, px, first.octave, first.sigma_px, first.descriptors)
    impostor = MapKeyframe(
        id=len(world.map.keyframes),
        frame=StoredFrame(Frame(99, 99.0, BLANK, CAMERA)),
        features=fake,
        T_camera_world=keyframe.T_camera_world.copy(),
        point_ids=np.full(n, -1, dtype=np.int64),
        log_depth=np.full(n, np.nan),
        sigma_log=np.full(n, np.nan),
        prediction=keyframe.prediction,
    )
    world.map.add_keyframe(impostor)
    poses = np.stack([k.T_camera_world for k in world.map.keyframes])
    world.closer.add(impostor, world.closer.describe(fake))
    assert world.closer.candidates(impostor)[:1] == [0]
    assert world.closer.close(impostor) is None
    np.testing.assert_array_equal(np.stack([k.T_camera_world for k in world.map.keyframes]), poses)


def test_a_keyframe_is_tied_to_those_it_shares_most_with_and_no_others() -> None:
    """Walking through one room for hours would otherwise tie each keyframe to every other."""
    world = World(3 * TURN, is_sensor=True)
    edges = world.closer._odometry_edges()
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
