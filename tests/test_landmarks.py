# SPDX-License-Identifier: Apache-2.0
"""The growing map: its counts agree with its keyframes, whatever is done to it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from slamdepth.geometry import se3_exp
from slamdepth.mapping.keyframe_store import StoredFrame
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.types import Camera, Frame

CAMERA = Camera(4, 3, 5, 5, 1.5, 1.0)
FRAME = Frame(0, 0.0, np.zeros((3, 4, 3), np.uint8), CAMERA)


@dataclass
class FakeFeatures:
    descriptors: np.ndarray
    octave: np.ndarray


def keyframe(id_: int, n: int = 8, T: np.ndarray | None = None) -> MapKeyframe:
    rng = np.random.default_rng(id_)
    return MapKeyframe(
        id=id_,
        frame=StoredFrame(FRAME),
        features=FakeFeatures(rng.integers(0, 256, (n, 32), dtype=np.uint8), rng.integers(0, 8, n)),
        T_camera_world=np.eye(4) if T is None else T,
        point_ids=np.full(n, -1, dtype=np.int64),
        log_depth=np.full(n, np.nan),
        sigma_log=np.full(n, np.nan),
    )


def born(landmarks: LandmarkMap, k: MapKeyframe, feature: list[int]) -> np.ndarray:
    n = len(feature)
    position = np.random.default_rng(landmarks.size).normal((0, 0, 5), size=(n, 3))
    return landmarks.add_points(k, np.array(feature, dtype=np.int64), position, np.tile(np.eye(3), (n, 1, 1)))


def see(landmarks: LandmarkMap, k: MapKeyframe, feature: int, row: int) -> None:
    """What the tracker does when it finds a known point at a free keypoint."""
    k.point_ids[feature] = row
    landmarks.observations[row] += 1


def recount(landmarks: LandmarkMap) -> np.ndarray:
    counts = np.zeros(landmarks.size, dtype=np.int64)
    for k in landmarks.keyframes:
        np.add.at(counts, k.point_ids[k.point_ids >= 0], 1)
    return counts


def check(landmarks: LandmarkMap) -> None:
    """What must hold after every operation."""
    n = landmarks.size
    alive = landmarks.alive[:n]
    counts = recount(landmarks)
    np.testing.assert_array_equal(landmarks.observations[:n][alive], counts[alive])
    assert (counts[~alive] == 0).all(), "a keyframe sees a dead point"
    assert (counts[alive] > 0).all(), "a living point that nobody sees"
    for k in landmarks.keyframes:
        seen = k.point_ids[k.point_ids >= 0]
        assert len(np.unique(seen)) == len(seen), "a keyframe sees a point twice"
    rows = np.arange(n)
    resolved = landmarks.resolve(rows)
    np.testing.assert_array_equal(resolved[alive], rows[alive])
    known = resolved[resolved >= 0]
    assert alive[known].all()
    assert not landmarks.alive[n:].any()


class MapOperations(RuleBasedStateMachine):
    """Everything the tracker does to its map, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.map = LandmarkMap()
        self.gone_into: dict[int, int] = {}

    @initialize()
    def start(self) -> None:
        self.new_keyframe(0)

    @rule(seed=st.integers(0, 1000))
    def new_keyframe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        k = keyframe(len(self.map.keyframes))
        living = np.flatnonzero(self.map.alive[: self.map.size])
        seen = rng.permutation(living)[: rng.integers(0, 6)]
        k.point_ids[rng.permutation(8)[: len(seen)]] = seen
        self.map.add_keyframe(k)
        free = np.flatnonzero(k.point_ids < 0)
        born(self.map, k, free[: rng.integers(0, 4)].tolist())

    @rule(seed=st.integers(0, 1000))
    def merge(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        living = rng.permutation(np.flatnonzero(self.map.alive[: self.map.size]))
        losers = living[: len(living) // 3]
        others = living[len(living) // 3 :]
        if len(others) == 0:
            return
        winners = others[rng.integers(0, len(others), len(losers))]
        self.map.merge(losers, winners)
        self.gone_into.update(zip(losers.tolist(), winners.tolist(), strict=True))

    @rule(seed=st.integers(0, 1000))
    def kill(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n = self.map.size
        self.map.kill(rng.permutation(n)[: rng.integers(0, 3)])

    @rule(seed=st.integers(0, 1000))
    def drop(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pairs = np.unique(rng.integers(0, (len(self.map.keyframes), 8), (4, 2)), axis=0)
        self.map.drop_observations(pairs[:, 0], pairs[:, 1])

    @rule()
    def compact(self) -> None:
        landmarks = self.map
        n = landmarks.size
        ends = landmarks.resolve(np.arange(n))
        position_w, descriptor = landmarks.position_w[ends].copy(), landmarks.descriptor[ends].copy()
        order = landmarks.alive[:n].nonzero()[0]
        landmarks._compact_at = 0
        now = landmarks.compact()
        assert now is not None
        assert now.shape == (n + 1,)
        assert now[-1] == -1
        assert landmarks.size == landmarks.alive.sum()
        np.testing.assert_array_equal(now[:n] >= 0, ends >= 0)
        np.testing.assert_array_equal(now[order], np.arange(landmarks.size))
        np.testing.assert_array_equal(landmarks.position_w[now[:n]][ends >= 0], position_w[ends >= 0])
        np.testing.assert_array_equal(landmarks.descriptor[now[:n]][ends >= 0], descriptor[ends >= 0])
        self.gone_into = {}  # those rows belong to others now

    @invariant()
    def consistent(self) -> None:
        check(self.map)

    @invariant()
    def merged_points_are_followed(self) -> None:
        for loser in self.gone_into:
            end = loser
            while end in self.gone_into:
                end = self.gone_into[end]
            expected = end if self.map.alive[end] else -1
            assert self.map.resolve(np.array([loser]))[0] == expected


TestMapOperations = MapOperations.TestCase
TestMapOperations.settings = settings(max_examples=40, stateful_step_count=15, deadline=None)


def test_birth() -> None:
    landmarks = LandmarkMap()
    k = keyframe(0, T=se3_exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2])))
    landmarks.add_keyframe(k)
    rows = born(landmarks, k, [1, 4])
    np.testing.assert_array_equal(k.point_ids, [-1, rows[0], -1, -1, rows[1], -1, -1, -1])
    np.testing.assert_array_equal(landmarks.descriptor[rows], k.features.descriptors[[1, 4]])
    np.testing.assert_array_equal(landmarks.octave[rows], k.features.octave[[1, 4]])
    offset = landmarks.position_w[rows] - k.center_w
    np.testing.assert_allclose(landmarks.distance_m[rows], np.linalg.norm(offset, axis=1))
    np.testing.assert_allclose(landmarks.direction_w[rows] * landmarks.distance_m[rows][:, None], offset)
    np.testing.assert_allclose(k.T_world_camera[:3, 3], k.center_w)
    check(landmarks)


def test_arrays_grow_beyond_their_capacity() -> None:
    landmarks = LandmarkMap()
    first = keyframe(0, 3000)
    landmarks.add_keyframe(first)
    rows = born(landmarks, first, list(range(3000)))
    before = landmarks.position_w[rows].copy()
    covariance = landmarks.covariance_w[rows].copy()
    second = keyframe(1, 20000)
    landmarks.add_keyframe(second)
    more = born(landmarks, second, list(range(20000)))
    assert landmarks.size == 23000
    np.testing.assert_array_equal(landmarks.position_w[rows], before)
    np.testing.assert_array_equal(landmarks.covariance_w[rows], covariance)
    np.testing.assert_array_equal(landmarks.alias[more], more)
    np.testing.assert_array_equal(landmarks.descriptor[more], second.features.descriptors)
    check(landmarks)


def test_rows_are_given_away_when_they_have_doubled() -> None:
    landmarks = LandmarkMap()
    first = keyframe(0, 5000)
    landmarks.add_keyframe(first)
    assert landmarks.compact() is None  # nothing to be had yet
    rows = born(landmarks, first, list(range(5000)))
    landmarks.kill(rows[::2])
    assert landmarks.compact() is not None
    assert landmarks.size == 2500
    assert len(landmarks.alive) == 5000
    assert landmarks.compact() is None
    for i in range(1, 41):  # a walk on which all that is born dies
        k = keyframe(i, 1000)
        landmarks.add_keyframe(k)
        landmarks.kill(born(landmarks, k, list(range(1000))))
        landmarks.compact()
        assert landmarks.size <= 6000
    assert len(landmarks.alive) <= 10000
    check(landmarks)


def test_merge_joins_what_was_seen() -> None:
    landmarks = LandmarkMap()
    a, b, c = (keyframe(i) for i in range(3))
    for k in (a, b, c):
        landmarks.add_keyframe(k)
    winner, own = born(landmarks, a, [0, 1])
    loser, extra = born(landmarks, b, [3, 4])
    see(landmarks, b, 0, winner)  # b sees both: it keeps the winner's keypoint
    see(landmarks, c, 5, loser)
    landmarks.visible[[winner, loser]] = [7, 5]
    landmarks.merge(np.array([loser]), np.array([winner]))
    assert landmarks.observations[winner] == 3
    assert (b.point_ids[3], b.point_ids[0], c.point_ids[5]) == (-1, winner, winner)
    assert landmarks.visible[winner] == 12
    np.testing.assert_array_equal(
        landmarks.resolve(np.array([loser, winner, -1, own, extra])), [winner, winner, -1, own, extra]
    )
    check(landmarks)


def test_a_long_chain_of_merges_is_followed_to_its_end() -> None:
    landmarks = LandmarkMap()
    k = keyframe(0, 40)
    landmarks.add_keyframe(k)
    rows = born(landmarks, k, list(range(40)))
    for loser, winner in pairwise(rows):
        landmarks.merge(np.array([loser]), np.array([winner]))
    np.testing.assert_array_equal(landmarks.resolve(rows), rows[-1])


def test_dropping_the_last_observation_kills() -> None:
    landmarks = LandmarkMap()
    a, b = keyframe(0), keyframe(1)
    landmarks.add_keyframe(a)
    landmarks.add_keyframe(b)
    one, two = born(landmarks, a, [0, 1])
    see(landmarks, b, 2, two)
    landmarks.drop_observations(np.array([0, 0, 1]), np.array([0, 1, 7]))
    assert not landmarks.alive[one]
    assert landmarks.alive[two]
    np.testing.assert_array_equal(landmarks.resolve(np.array([one, two])), [-1, two])
    check(landmarks)


def test_covisibility() -> None:
    landmarks = LandmarkMap()
    for i in range(3):
        landmarks.add_keyframe(keyframe(i))
    rows = born(landmarks, landmarks.keyframes[0], [0, 1, 2, 3])
    for feature in range(3):
        see(landmarks, landmarks.keyframes[2], feature, rows[feature])
    see(landmarks, landmarks.keyframes[1], 0, rows[3])
    np.testing.assert_array_equal(landmarks.shared_points(np.append(rows, -1)), [4, 1, 3])
    assert landmarks.covisible(rows, 2) == [0, 2]
    assert landmarks.covisible(rows, 3, minimum=2) == [0, 2]
    assert landmarks.covisible(rows[:0], 3) == []
    together = landmarks.covisibility()
    np.testing.assert_array_equal(together, [[4, 1, 3], [1, 1, 0], [3, 0, 3]])
    for k in landmarks.keyframes:
        np.testing.assert_array_equal(together[k.id], landmarks.shared_points(k.point_ids))
    np.testing.assert_array_equal(landmarks.times_seen(rows, 3), [2, 2, 2, 2])
    np.testing.assert_array_equal(landmarks.times_seen(rows[2:], 2), [1, 2])
    np.testing.assert_array_equal(landmarks.points_of([1, 2]), rows)
    landmarks.kill(rows[:1])
    np.testing.assert_array_equal(landmarks.points_of([0, 1, 2]), rows[1:])
    assert landmarks.points_of([]).shape == (0,)
    check(landmarks)


def test_doubt_along_the_ray() -> None:
    landmarks = LandmarkMap()
    k = keyframe(0)
    landmarks.add_keyframe(k)
    position = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 4.0]])
    covariance = np.stack([np.diag([9.0, 9.0, 0.04]), 0.25 * np.eye(3)])
    rows = landmarks.add_points(k, np.array([0, 1]), position, covariance)
    np.testing.assert_allclose(landmarks.sigma_along_ray(rows, np.zeros(3)), [0.1, 0.1])
    np.testing.assert_allclose(landmarks.sigma_along_ray(rows[:1], np.array([-2.0, 0.0, 2.0])), [1.5])


def test_refresh_views_after_a_move() -> None:
    landmarks = LandmarkMap()
    k = keyframe(0)
    landmarks.add_keyframe(k)
    rows = born(landmarks, k, [0, 1])
    k.T_camera_world = se3_exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    landmarks.refresh_views(rows)
    np.testing.assert_allclose(
        landmarks.distance_m[rows], np.linalg.norm(landmarks.position_w[rows] + [0, 0, 1], axis=1)
    )
    assert pytest.approx(1.0) == np.linalg.norm(landmarks.direction_w[rows[0]])
