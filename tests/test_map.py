# SPDX-License-Identifier: Apache-2.0
"""The growing map: its counts agree with its keyframes, whatever is done to it."""

from __future__ import annotations

import numpy as np
import pytest
from growing_map import add_keyframe, check, create, ids_of, see
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from slamdepth.geometry import se3_exp
from slamdepth.mapping.map import Map
from slamdepth.typing import Ints

seeds = st.integers(0, 1000)


class MapOperations(RuleBasedStateMachine):
    """Everything the tracker does to its map, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.map = Map()
        self.fused_into: dict[int, int] = {}

    @initialize()
    def start(self) -> None:
        self.new_keyframe(0)

    def _living(self, rng: np.random.Generator) -> Ints:
        """Living landmarks in any order."""
        return rng.permutation(np.flatnonzero(self.map.landmarks.alive))

    @rule(seed=seeds)
    def new_keyframe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        ids = np.full(8, -1, dtype=np.int64)
        seen = self._living(rng)[: rng.integers(0, 6)]
        ids[rng.permutation(8)[: len(seen)]] = seen
        keyframe = add_keyframe(self.map, ids=ids)
        np.testing.assert_array_equal(keyframe.landmark_ids, ids)
        free = np.flatnonzero(ids < 0)
        create(self.map, keyframe, free[: rng.integers(0, 4)].tolist())

    @rule(seed=seeds)
    def fuse(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        living = self._living(rng)
        losers, others = living[: len(living) // 3], living[len(living) // 3 :]
        if len(others) == 0:
            return
        winners = others[rng.integers(0, len(others), len(losers))]
        self.map.fuse(losers, winners)
        self.fused_into.update(zip(losers.tolist(), winners.tolist(), strict=True))

    @rule(seed=seeds)
    def observe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        keyframe = self.map.keyframes[rng.integers(len(self.map.keyframes))]
        was = keyframe.landmark_ids.copy()
        ids = self._living(rng)
        ids = ids[~np.isin(ids, was)][: rng.integers(0, 6)]
        features = rng.permutation(8)[: len(ids)]
        self.map.observe(keyframe, features, ids)
        self._note_fusions(ids, was[features])
        np.testing.assert_array_equal(keyframe.landmark_ids[features], self.map.resolve(ids))

    @rule(seed=seeds)
    def fuse_view(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        keyframe = self.map.keyframes[rng.integers(len(self.map.keyframes))]
        was = keyframe.landmark_ids.copy()
        ids = np.full(8, -1, dtype=np.int64)
        other_side = self._living(rng)[: rng.integers(0, 6)]
        ids[rng.permutation(8)[: len(other_side)]] = other_side
        self.map.fuse_view(keyframe, ids)
        fresh = (ids >= 0) & ~np.isin(ids, was)  # what the keyframe sees already stays where it is
        self._note_fusions(ids[fresh], was[fresh])

    def _note_fusions(self, ids: Ints, was: Ints) -> None:
        """Remember which of two landmarks is left where a feature saw one and was given another."""
        alive = self.map.landmarks.alive
        for one, other in zip(ids.tolist(), was.tolist(), strict=True):
            if other >= 0 and not alive[one]:
                self.fused_into[one] = other
            elif other >= 0 and not alive[other]:
                self.fused_into[other] = one

    @rule(seed=seeds)
    def remove(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.map.remove(rng.permutation(self.map.size)[: rng.integers(0, 3)])

    @rule(seed=seeds)
    def forget_observations(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pairs = np.unique(rng.integers(0, (len(self.map.keyframes), 8), (4, 2)), axis=0)
        self.map.forget_observations(pairs[:, 0], pairs[:, 1])

    @rule()
    def cull(self) -> None:
        self.map.cull(self.map.keyframes[-1])

    @rule()
    def compact(self) -> None:
        map_ = self.map
        n = map_.size
        ends = map_.resolve(np.arange(n))
        position_w, descriptor = map_.landmarks.position_w[ends], map_.landmarks.descriptor[ends]
        living = np.flatnonzero(map_.landmarks.alive)
        map_._compact_at = 0
        now = map_.compact()
        assert now is not None
        assert now.shape == (n + 1,)
        assert now[-1] == -1
        assert map_.size == map_.landmarks.alive.sum()
        np.testing.assert_array_equal(now[:n] >= 0, ends >= 0)
        np.testing.assert_array_equal(now[living], np.arange(map_.size))
        known, ids = ends >= 0, now[:n]
        np.testing.assert_array_equal(map_.landmarks.position_w[ids[known]], position_w[known])
        np.testing.assert_array_equal(map_.landmarks.descriptor[ids[known]], descriptor[known])
        self.fused_into = {}  # those ids belong to others now

    @invariant()
    def counts_agree_with_keyframes(self) -> None:
        check(self.map)

    @invariant()
    def fused_landmarks_are_followed(self) -> None:
        for loser in self.fused_into:
            end = loser
            while end in self.fused_into:
                end = self.fused_into[end]
            expected = end if self.map.landmarks.alive[end] else -1
            assert self.map.resolve(ids_of(loser))[0] == expected


TestMapOperations = MapOperations.TestCase
TestMapOperations.settings = settings(max_examples=40, stateful_step_count=15, deadline=None)


def test_new_landmarks_take_what_their_keyframe_knows() -> None:
    map_ = Map()
    keyframe = add_keyframe(map_, T_camera_world=se3_exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2])))
    ids = create(map_, keyframe, [1, 4])
    np.testing.assert_array_equal(keyframe.landmark_ids, [-1, ids[0], -1, -1, ids[1], -1, -1, -1])
    landmarks = map_.landmarks
    np.testing.assert_array_equal(landmarks.descriptor[ids], keyframe.features.descriptors[[1, 4]])
    np.testing.assert_array_equal(landmarks.octave[ids], keyframe.features.octave[[1, 4]])
    np.testing.assert_array_equal(landmarks.anchor_keyframe[ids], keyframe.id)
    offset = landmarks.position_w[ids] - keyframe.center_w
    np.testing.assert_allclose(landmarks.distance_m[ids], np.linalg.norm(offset, axis=1))
    np.testing.assert_allclose(landmarks.direction_w[ids] * landmarks.distance_m[ids][:, None], offset)
    np.testing.assert_allclose(keyframe.T_world_camera[:3, 3], keyframe.center_w)
    check(map_)


def test_arrays_grow_beyond_their_capacity() -> None:
    map_ = Map()
    first = add_keyframe(map_, 3000)
    ids = create(map_, first, range(3000))
    before = map_.landmarks.position_w[ids]
    covariance = map_.landmarks.covariance_w[ids]
    second = add_keyframe(map_, 20000)
    more = create(map_, second, range(20000))
    assert map_.size == 23000
    np.testing.assert_array_equal(map_.landmarks.position_w[ids], before)
    np.testing.assert_array_equal(map_.landmarks.covariance_w[ids], covariance)
    np.testing.assert_array_equal(map_.landmarks.alias[more], more)
    np.testing.assert_array_equal(map_.landmarks.descriptor[more], second.features.descriptors)
    check(map_)


def test_ids_are_given_to_others_when_they_have_doubled() -> None:
    map_ = Map()
    first = add_keyframe(map_, 5000)
    assert map_.compact() is None  # nothing to gain yet
    ids = create(map_, first, range(5000))
    map_.remove(ids[::2])
    assert map_.compact() is not None
    assert map_.size == 2500
    assert len(map_._own) == 5000
    assert map_.compact() is None
    for _ in range(40):  # a walk on which every new landmark is removed
        keyframe = add_keyframe(map_, 1000)
        map_.remove(create(map_, keyframe, range(1000)))
        map_.compact()
        assert map_.size <= 6000
    assert len(map_._own) <= 10000
    check(map_)


def test_covisibility() -> None:
    map_ = Map()
    a, b, c = (add_keyframe(map_) for _ in range(3))
    ids = create(map_, a, [0, 1, 2, 3])
    for feature in range(3):
        see(map_, c, feature, ids[feature])
    see(map_, b, 0, ids[3])
    np.testing.assert_array_equal(map_.shared_landmarks(np.append(ids, -1)), [4, 1, 3])
    assert map_.covisible(ids, 2) == [0, 2]
    assert map_.covisible(ids, 3, minimum=2) == [0, 2]
    assert map_.covisible(ids[:0], 3) == []
    together = map_.covisibility()
    np.testing.assert_array_equal(together, [[4, 1, 3], [1, 1, 0], [3, 0, 3]])
    for keyframe in map_.keyframes:
        np.testing.assert_array_equal(together[keyframe.id], map_.shared_landmarks(keyframe.landmark_ids))
    np.testing.assert_array_equal(map_.times_seen(ids, 3), [2, 2, 2, 2])
    np.testing.assert_array_equal(map_.times_seen(ids[2:], 2), [1, 2])
    np.testing.assert_array_equal(map_.seen_from([1, 2]), ids)
    map_.remove(ids[:1])
    np.testing.assert_array_equal(map_.seen_from([0, 1, 2]), ids[1:])
    assert map_.seen_from([]).shape == (0,)
    check(map_)


def test_uncertainty_along_the_ray() -> None:
    map_ = Map()
    keyframe = add_keyframe(map_)
    position = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 4.0]])
    covariance = np.stack([np.diag([9.0, 9.0, 0.04]), 0.25 * np.eye(3)])
    ids = map_.create_landmarks(keyframe, ids_of(0, 1), position, covariance)
    np.testing.assert_allclose(map_.sigma_along_ray(ids, np.zeros(3)), [0.1, 0.1])
    np.testing.assert_allclose(map_.sigma_along_ray(ids[:1], np.array([-2.0, 0.0, 2.0])), [1.5])


def test_the_first_landmarks_say_what_a_descriptor_is() -> None:
    map_ = Map()
    assert map_.landmarks.descriptor.shape == (0, 0)
    create(map_, add_keyframe(map_), [0])
    assert map_.landmarks.descriptor.shape == (1, 32)
    assert map_.landmarks.descriptor.dtype == np.uint8


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_to_fuse_or_remove(count: int) -> None:
    map_ = Map()
    create(map_, add_keyframe(map_), range(count))
    map_.fuse(ids_of(), ids_of())
    map_.remove(ids_of())
    map_.observe(map_.keyframes[0], ids_of(), ids_of())
    assert map_.size == count
    check(map_)
