# SPDX-License-Identifier: Apache-2.0
"""What keyframes see: observed, fused, forgotten and culled."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from growing_map import add_keyframe, check, create, ids_of, see

from slamdepth.mapping.map import AdjustedLandmarks, Map


def test_fusing_joins_what_was_seen() -> None:
    map_ = Map()
    a, b, c = (add_keyframe(map_) for _ in range(3))
    winner, own = create(map_, a, [0, 1])
    loser, extra = create(map_, b, [3, 4])
    see(map_, b, 0, winner)  # b sees both: it keeps the winner's feature
    see(map_, c, 5, loser)
    for expected, found, id_ in ((6, 2, winner), (4, 3, loser)):  # counted once when it was created
        for n in range(expected):
            map_.count_views(ids_of(id_), ids_of(id_) if n < found else ids_of())
    map_.fuse(ids_of(loser), ids_of(winner))
    assert map_.landmarks.observations[winner] == 3
    assert (b.landmark_ids[3], b.landmark_ids[0], c.landmark_ids[5]) == (-1, winner, winner)
    assert map_.landmarks.expected[winner] == 12
    assert map_.landmarks.found[winner] == 7
    np.testing.assert_array_equal(
        map_.resolve(ids_of(loser, winner, -1, own, extra)), [winner, winner, -1, own, extra]
    )
    check(map_)


def test_a_long_chain_of_fusions_is_followed_to_its_end() -> None:
    map_ = Map()
    ids = create(map_, add_keyframe(map_, 40), range(40))
    for loser, winner in pairwise(ids.tolist()):
        map_.fuse(ids_of(loser), ids_of(winner))
    np.testing.assert_array_equal(map_.resolve(ids), ids[-1])


def test_a_landmark_without_observations_is_removed() -> None:
    map_ = Map()
    a, b = add_keyframe(map_), add_keyframe(map_)
    one, two = create(map_, a, [0, 1])
    see(map_, b, 2, two)
    map_.forget_observations(ids_of(0, 0, 1), ids_of(0, 1, 7))
    assert not map_.landmarks.alive[one]
    assert map_.landmarks.alive[two]
    np.testing.assert_array_equal(map_.resolve(ids_of(one, two)), [-1, two])
    check(map_)


def test_observing_fills_free_features_and_fuses_into_what_more_keyframes_see() -> None:
    map_ = Map()
    a, b, c, d = (add_keyframe(map_) for _ in range(4))
    free, weak, strong, even = create(map_, a, [0, 1, 2, 3])
    seen_twice, seen_once, as_often = create(map_, b, [0, 1, 2])
    see(map_, c, 0, seen_twice)
    see(map_, c, 1, strong)
    see(map_, d, 0, strong)
    gone = create(map_, a, [7])[0]
    map_.remove(ids_of(gone))
    map_.observe(b, ids_of(5, 0, 1, 2), ids_of(free, weak, strong, even))
    assert b.landmark_ids[5] == free
    assert map_.landmarks.observations[free] == 2
    # the landmark that the feature saw wins, unless fewer keyframes see it
    np.testing.assert_array_equal(
        map_.resolve(ids_of(weak, seen_twice, strong, seen_once, even, as_often)),
        [seen_twice, seen_twice, strong, strong, as_often, as_often],
    )
    np.testing.assert_array_equal(b.landmark_ids[:3], [seen_twice, strong, as_often])
    assert a.landmark_ids[1] == seen_twice
    np.testing.assert_array_equal(map_.landmarks.observations[[seen_twice, strong, as_often]], [3, 4, 2])
    map_.observe(d, ids_of(0), ids_of(gone))  # nothing is fused into a landmark that is gone
    assert d.landmark_ids[0] == strong
    check(map_)


def test_fusing_a_view_replaces_a_keyframe_s_landmarks_by_those_of_the_other_side() -> None:
    map_ = Map()
    old, new = add_keyframe(map_), add_keyframe(map_)
    there = create(map_, old, [0, 1, 2, 3])
    here = create(map_, new, [0, 1])
    see(map_, new, 5, there[3])
    gone = create(map_, old, [7])
    map_.remove(gone)
    map_.fuse_view(new, ids_of(there[0], -1, there[1], there[2], gone[0], there[3], -1, -1))
    np.testing.assert_array_equal(
        new.landmark_ids, [there[0], here[1], there[1], there[2], -1, there[3], -1, -1]
    )
    np.testing.assert_array_equal(map_.resolve(here), [there[0], here[1]])
    np.testing.assert_array_equal(map_.landmarks.observations[there], [2, 2, 2, 2])
    check(map_)
    # one that the keyframe sees already is neither seen twice nor fused
    map_.fuse_view(new, ids_of(-1, there[0], -1, -1, -1, -1, there[1], -1))
    np.testing.assert_array_equal(
        new.landmark_ids, [there[0], here[1], there[1], there[2], -1, there[3], -1, -1]
    )
    check(map_)


def test_culling_removes_what_is_seldom_found_or_seen_by_one_keyframe_only() -> None:
    map_ = Map()
    first = add_keyframe(map_)
    kept, seldom, established, lonely, invalid = create(map_, first, range(5))
    ids = ids_of(kept, seldom, established, lonely, invalid)
    others = [add_keyframe(map_) for _ in range(4)]
    for id_ in (kept, seldom, invalid):
        see(map_, others[0], int(id_), id_)
    for keyframe in others:
        see(map_, keyframe, 6, established)
    for _ in range(4):  # expected five times with the one that created it, and found that once
        map_.count_views(ids_of(seldom, established), ids_of())
    unknown = AdjustedLandmarks(ids_of(invalid), np.array([[0.0, np.nan, 5.0]]), np.eye(3)[None])
    map_.correct([], np.zeros((0, 4, 4)), adjusted=unknown)
    map_.cull(others[-1])
    np.testing.assert_array_equal(map_.resolve(ids), [kept, -1, established, -1, -1])
    check(map_)


def test_culling_gives_a_landmark_of_the_newest_keyframe_and_of_its_neighbours_a_chance() -> None:
    map_ = Map()
    first = add_keyframe(map_)
    lonely = create(map_, first, [0])
    second = add_keyframe(map_)
    seldom = create(map_, second, [0])
    for _ in range(9):
        map_.count_views(seldom, ids_of())
    map_.cull(second)
    np.testing.assert_array_equal(map_.resolve(np.append(lonely, seldom)), np.append(lonely, seldom))
    third = add_keyframe(map_)
    map_.cull(third)
    np.testing.assert_array_equal(map_.resolve(np.append(lonely, seldom)), [*lonely, -1])
    map_.cull(add_keyframe(map_))
    assert not map_.landmarks.alive.any()  # three keyframes on, and still seen by one
    check(map_)
