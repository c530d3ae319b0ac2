# SPDX-License-Identifier: Apache-2.0
"""Distances of descriptors against the obvious, slow way, and matching by any of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.frontend.matching import best_matches, match_all
from slamdepth.frontend.metric import (
    FARTHEST,
    DescriptorMetric,
    Hamming,
    UnitL2,
    hamming,
    hamming_table,
    whole_words,
)

seeds = st.integers(0, 2**32 - 1)
METRICS: list[DescriptorMetric] = [
    Hamming(32, 64, 50),
    Hamming(61, 120, 95),
    Hamming(64, 120, 95),
    Hamming(7, 14, 10),
    UnitL2(128, 0.7, 0.5),
    UnitL2(3, 0.3, 0.2),
]


def binary(count: int, size: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, size), dtype=np.uint8)


def random_descriptors(metric: DescriptorMetric, count: int, rng: np.random.Generator) -> np.ndarray:
    none = metric.empty()
    if none.dtype == np.uint8:
        return rng.integers(0, 256, (count, none.shape[1]), dtype=np.uint8)
    vectors = rng.normal(size=(count, none.shape[1]))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors.astype(np.float32)


def slow_distance(a: np.ndarray, b: np.ndarray) -> float:
    if a.dtype == np.uint8:
        return float(np.count_nonzero(np.unpackbits(a) != np.unpackbits(b)))
    return float(np.linalg.norm(a.astype(float) - b.astype(float)) * FARTHEST / 2)


def test_hamming_counts_bits() -> None:
    a, b = binary(7, 32), binary(5, 32, 1)
    slow = (np.unpackbits(a, axis=1)[:, None] != np.unpackbits(b, axis=1)[None]).sum(axis=2)
    np.testing.assert_array_equal(hamming_table(a, b), slow)
    np.testing.assert_array_equal(hamming(a[:5], b), np.diag(slow[:5]))
    np.testing.assert_array_equal(hamming(a, a), 0)
    np.testing.assert_array_equal(hamming(a, ~a), 256)
    assert hamming_table(a[:0], b).shape == (0, 5)
    assert hamming(a[:0], b[:0]).shape == (0,)


@pytest.mark.parametrize("metric", METRICS, ids=repr)
@settings(deadline=None)
@given(seed=seeds, n=st.integers(0, 12), m=st.integers(0, 12))
def test_a_metric_is_brute_force(metric: DescriptorMetric, seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_descriptors(metric, n, rng), random_descriptors(metric, m, rng)
    slow = np.array([[slow_distance(x, y) for y in b] for x in a]).reshape(n, m)
    table = metric.table(a, b)
    assert table.dtype == np.uint16
    np.testing.assert_allclose(table, slow, atol=0.51)
    k = min(n, m)
    rows = metric.between(a[:k], b[:k])
    assert rows.dtype == np.int64
    np.testing.assert_array_equal(rows, np.diag(table))


@pytest.mark.parametrize("metric", METRICS, ids=repr)
@settings(deadline=None)
@given(seed=seeds, n=st.integers(0, 30), m=st.integers(0, 30))
def test_match_all_is_brute_force(metric: DescriptorMetric, seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    b = random_descriptors(metric, m, rng)
    a = random_descriptors(metric, n, rng)
    seen_again = rng.permutation(m)[: min(n, m) // 2]
    a[: len(seen_again)] = b[seen_again]
    table = metric.table(a, b).astype(int)
    expected = []
    for i in range(n):
        order = np.argsort(table[i], kind="stable")
        if m < 2 or table[:, order[0]].argmin() != i or table[i, order[0]] > metric.max_distance:
            continue
        if table[i, order[0]] <= 0.8 * table[i, order[1]]:
            expected.append((i, int(order[0]), int(table[i, order[0]])))
    found = match_all(a, b, metric=metric, ratio=0.8)
    assert list(zip(*(x.tolist() for x in found), strict=True)) == expected


def test_unit_vectors_opposite_are_farthest_and_the_same_are_nearest() -> None:
    metric = UnitL2(2, 1.0, 0.5)
    a = np.array([[1.0, 0.0], [0.6, 0.8], [1.0, 0.0]], np.float32)
    b = np.array([[-1.0, 0.0], [0.6, 0.8], [0.0, 1.0]], np.float32)
    np.testing.assert_array_equal(metric.between(a, b), [FARTHEST, 0, round(np.sqrt(2) * FARTHEST / 2)])
    assert (metric.max_distance, metric.strict_distance) == (FARTHEST // 2, FARTHEST // 4)


def test_long_binary_descriptors_stay_within_what_matching_packs() -> None:
    metric = Hamming(256, 400, 300)
    a = binary(1, 256)
    np.testing.assert_array_equal(metric.between(a, ~a), [FARTHEST])
    np.testing.assert_array_equal(metric.table(a, ~a), [[FARTHEST]])
    q, t, d = best_matches(
        np.array([0, 0]), np.array([4, 9]), np.array([3, FARTHEST]), max_distance=400, ratio=0.8
    )
    assert (q.tolist(), t.tolist(), d.tolist()) == ([0], [4], [3])


@settings(deadline=None)
@given(seeds, st.integers(1, 40))
def test_filling_up_changes_no_distance(seed: int, size: int) -> None:
    a, b = binary(4, size, seed), binary(4, size, seed + 1)
    wide = whole_words(a)
    assert wide.shape[1] % 8 == 0
    np.testing.assert_array_equal(wide[:, :size], a)
    np.testing.assert_array_equal(hamming(wide, whole_words(b)), hamming(a, b))
