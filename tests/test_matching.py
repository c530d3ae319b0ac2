# SPDX-License-Identifier: Apache-2.0
"""Matching against the obvious, slow way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.frontend.matching import PixelGrid, best_matches, match_all

seeds = st.integers(0, 2**32 - 1)


def descriptors(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 32), dtype=np.uint8)


def flip(rows: np.ndarray, bits: int, seed: int = 0) -> np.ndarray:
    """The descriptors with so many bits turned over."""
    rng = np.random.default_rng(seed)
    unpacked = np.unpackbits(rows, axis=1)
    for row in unpacked:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(unpacked, axis=1)


@settings(deadline=None)
@given(seeds, st.integers(0, 25), st.integers(0, 25), st.sampled_from([1.0, 8.0, 40.0, 2000.0]))
def test_pairs_within_is_brute_force(seed: int, m: int, n: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    query, px = rng.uniform(-60, 60, (m, 2)), rng.uniform(-40, 50, (n, 2))
    radius = rng.uniform(0.5, 1, m) * reach
    q, t = PixelGrid(px).pairs_within(query, radius)
    assert q.shape == t.shape
    found = set(zip(q.tolist(), t.tolist(), strict=True))
    assert len(found) == len(q), "a pair came twice"
    square = ((query[:, None] - px[None]) ** 2).sum(2) if m and n else np.zeros((m, n))
    assert found == set(zip(*(x.tolist() for x in np.nonzero(square <= radius[:, None] ** 2)), strict=True))


def test_pairs_within_takes_the_rim_and_mixed_radii() -> None:
    px = np.array([[0.0, 0.0], [12.0, 0.0], [30.0, 0.0], [31.0, 0.0], [500.0, 0.0]])
    query = np.zeros((4, 2))
    q, t = PixelGrid(px).pairs_within(query, np.array([12.0, 12.1, 30.0, 1000.0]))
    assert [sorted(t[q == i].tolist()) for i in range(4)] == [[0, 1], [0, 1], [0, 1, 2], [0, 1, 2, 3, 4]]


def test_pairs_within_nothing() -> None:
    for query, px in ((np.zeros((0, 2)), np.ones((3, 2))), (np.ones((3, 2)), np.zeros((0, 2)))):
        q, t = PixelGrid(px).pairs_within(query, np.full(len(query), 5.0))
        assert len(q) == len(t) == 0
    q, _ = PixelGrid(np.ones((3, 2))).pairs_within(np.full((1, 2), 1e6), np.array([5.0]))
    assert len(q) == 0


def test_small_radii_over_a_large_image_need_no_large_grid() -> None:
    q, t = PixelGrid(np.array([[5.0, 5.0], [4000.0, 3000.0]])).pairs_within(
        np.array([[5.0, 5.0]]), np.array([1e-4])
    )
    assert (q.tolist(), t.tolist()) == ([0], [0])


@settings(deadline=None)
@given(seeds, st.integers(1, 60))
def test_best_matches_is_one_to_one_and_near(seed: int, pairs: int) -> None:
    rng = np.random.default_rng(seed)
    every = np.unique(rng.integers(0, 8, (pairs, 2)), axis=0)
    every = rng.permutation(every)
    distance = rng.integers(0, 90, len(every))
    q, t, d = best_matches(every[:, 0], every[:, 1], distance, max_distance=64, ratio=0.9)
    assert len(set(q.tolist())) == len(q)
    assert len(set(t.tolist())) == len(t)
    assert (np.diff(q) > 0).all()
    for a, b, score in zip(q, t, d, strict=True):
        rivals = np.sort(distance[every[:, 0] == a])
        assert score == rivals[0] <= 64
        assert len(rivals) == 1 or score <= 0.9 * rivals[1]
        assert score == distance[(every == [a, b]).all(axis=1)][0]


def test_a_target_wanted_by_two_keeps_the_nearest() -> None:
    q, t, d = best_matches(
        np.array([0, 1, 2]), np.array([5, 5, 6]), np.array([30, 20, 10]), max_distance=64, ratio=0.9
    )
    assert (q.tolist(), t.tolist(), d.tolist()) == ([1, 2], [5, 6], [20, 10])


@pytest.mark.parametrize(("second", "kept"), [(25, True), (24, True), (22, False), (20, False)])
def test_ratio(second: int, kept: bool) -> None:
    q, _, _ = best_matches(
        np.array([0, 0]), np.array([0, 1]), np.array([20, second]), max_distance=64, ratio=0.85
    )
    assert (len(q) == 1) == kept


def test_match_all_finds_a_permutation() -> None:
    a = descriptors(80)
    order = np.random.default_rng(1).permutation(80)
    i, j, d = match_all(a, flip(a[order], 12))
    np.testing.assert_array_equal(i, np.arange(80))
    np.testing.assert_array_equal(order[j], i)
    np.testing.assert_array_equal(d, 12)


def test_match_all_is_mutual_and_refuses_strangers() -> None:
    a = descriptors(40)
    b = np.concatenate([flip(a[:20], 10), descriptors(30, 9)])
    i, j, _ = match_all(a, b)
    np.testing.assert_array_equal(i, np.arange(20))
    np.testing.assert_array_equal(j, np.arange(20))
    j2, i2, _ = match_all(b, a)
    np.testing.assert_array_equal(i2, i)
    np.testing.assert_array_equal(j2, j)
    twins = np.concatenate([flip(a[:1], 10, 1), flip(a[:1], 11, 2)])
    assert len(match_all(a[:5], twins)[0]) == 0  # as near to one as to the other


def test_match_all_of_almost_nothing() -> None:
    for n, m in ((0, 5), (5, 0), (5, 1), (0, 0)):
        i, j, d = match_all(descriptors(n), descriptors(m, 1))
        assert len(i) == len(j) == len(d) == 0
