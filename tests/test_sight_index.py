# SPDX-License-Identifier: Apache-2.0
"""The index of which keyframes may see a landmark misses none, whatever happens to a map."""

from __future__ import annotations

import numpy as np
from growing_map import add_keyframe, create, ids_of

from slamdepth.mapping.map import Map
from slamdepth.mapping.sight_index import SightIndex


def grown(seed: int, keyframes: int = 40, features: int = 60) -> Map:
    """A map in which landmarks are created, seen again, fused and removed at random."""
    rng = np.random.default_rng(seed)
    map_ = Map()
    for _ in range(keyframes):
        alive = np.flatnonzero(map_.landmarks.alive)
        again = rng.permutation(alive)[: features // 3]
        ids = np.full(features, -1, dtype=np.int64)
        ids[: len(again)] = again
        keyframe = add_keyframe(map_, features, ids=ids)
        create(map_, keyframe, np.flatnonzero(keyframe.landmark_ids < 0)[:20].tolist())
        other = map_.keyframes[int(rng.integers(len(map_.keyframes)))]
        unseen = np.setdiff1d(np.flatnonzero(map_.landmarks.alive), other.landmark_ids)
        few = rng.permutation(unseen)[:5]
        map_.observe(other, rng.permutation(features)[: len(few)], few)
        alive = rng.permutation(np.flatnonzero(map_.landmarks.alive))
        map_.fuse(alive[:2], alive[2:4])
        map_.remove(alive[4:7])
    return map_


def check(map_: Map) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        ids = rng.integers(0, map_.size, 3)
        mask = map_.mask(ids)
        counted = [np.count_nonzero(mask[keyframe.landmark_ids]) for keyframe in map_.keyframes]
        np.testing.assert_array_equal(map_.shared_landmarks(ids), counted)
        times = [sum(int(i in k.landmark_ids) for k in map_.keyframes[:30]) for i in ids.tolist()]
        np.testing.assert_array_equal(map_.times_seen(ids, 30), times)


def test_no_keyframe_that_sees_a_landmark_is_missed() -> None:
    for seed in range(3):
        check(grown(seed))


def test_nor_after_ids_were_given_away_or_another_map_was_absorbed() -> None:
    map_ = grown(3)
    map_._compact_at = 0
    assert map_.compact() is not None
    check(map_)
    map_.absorb(grown(4))
    check(map_)


def test_keyframes_elsewhere_are_not_looked_at() -> None:
    index = SightIndex()
    for k in range(100):
        index.note(k, np.arange(500 * k, 500 * k + 500))
    wanted = np.zeros(50_001, dtype=bool)
    wanted[500 * 7 + 3] = True
    assert index.candidates(wanted) == [6, 7] or index.candidates(wanted) == [7]
    assert index.candidates(np.zeros(50_001, dtype=bool)) == []
    index.note(3, ids_of(-1, -1))
    assert index.candidates(np.zeros(1, dtype=bool)) == []
