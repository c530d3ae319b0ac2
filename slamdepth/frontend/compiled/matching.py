# SPDX-License-Identifier: Apache-2.0
"""Matching by Hamming distance, compiled; descriptors are rows of 64-bit words.

The twins in NumPy are :func:`slamdepth.tracking.landmark_search.match_landmarks`, which says what the numbers
mean, :class:`slamdepth.frontend.matching.PixelGrid`, :func:`slamdepth.frontend.matching.match_all` and
:func:`slamdepth.frontend.metric.hamming_nearest`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.compiled.jit import compiled, inlined
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Words = NDArray[np.uint64]

_NO_SECOND = 1 << 30
_ONES = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F)
_BYTES = np.uint64(0x0101010101010101)
_1, _2, _4, _56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@inlined
def _bits(word: Any) -> Any:
    """Number of ones in 64 bits; LLVM turns this into one instruction."""
    word = word - ((word >> _1) & _ONES[0])
    word = (word & _ONES[1]) + ((word >> _2) & _ONES[1])
    word = (word + (word >> _4)) & _ONES[2]
    return np.int64((word * _BYTES) >> _56)


@inlined
def _distances(words: Words, columns: Words, out: Ints) -> None:
    """Distances ``(M,)`` of one descriptor from those in ``columns (words, M)``."""
    out[:] = 0
    for w in range(len(words)):
        word, others = words[w], columns[w]
        for j in range(len(out)):
            out[j] += _bits(word ^ others[j])


@compiled
def nearest(a: Words, columns: Words) -> Ints:
    """Index ``(N,)`` of the descriptor in ``columns (words, M)`` nearest to each of ``a``; lowest of ties."""
    distance = np.empty(columns.shape[1], np.int64)
    out = np.empty(len(a), np.int64)
    for i in range(len(a)):
        _distances(a[i], columns, distance)
        best = 0
        for j in range(1, len(distance)):
            if distance[j] < distance[best]:
                best = j
        out[i] = best
    return out


@compiled
def mutual(a: Words, columns: Words, max_distance: int, ratio: float) -> tuple[Ints, Ints, Ints]:
    """Mutual nearest neighbours of ``a`` and ``columns (words, M)``: indices in both, and distances."""
    distance = np.empty(columns.shape[1], np.int64)
    best_of_b = np.full(columns.shape[1], 1 << 30, np.int64)
    row_of_b = np.empty(columns.shape[1], np.int64)
    b_of_a = np.empty(len(a), np.int64)
    best_of_a = np.empty(len(a), np.int64)
    is_clear = np.empty(len(a), np.bool_)
    for i in range(len(a)):
        _distances(a[i], columns, distance)
        best, second, at = 1 << 30, 1 << 30, 0
        for j in range(len(distance)):
            if distance[j] < best:
                best, second, at = distance[j], best, j
            elif distance[j] < second:
                second = distance[j]
            if distance[j] < best_of_b[j]:
                best_of_b[j], row_of_b[j] = distance[j], i
        b_of_a[i], best_of_a[i] = at, best
        is_clear[i] = best <= max_distance and best <= ratio * second
    kept = np.zeros(len(a), np.bool_)
    for i in range(len(a)):
        kept[i] = is_clear[i] and row_of_b[b_of_a[i]] == i
    return np.flatnonzero(kept), b_of_a[kept], best_of_a[kept]


@compiled
def grid(px: Floats, cell_px: float, most_cells: int) -> tuple[Floats, float, int, int, Ints, Ints]:
    """Pixels ``(N, 2)``, at least one, sorted into cells.

    Returns:
        Lowest pixel, edge of a cell, columns, rows, indices sorted by cell, and where each cell starts.
    """
    low = np.array([np.min(px[:, 0]), np.min(px[:, 1])])
    extent = max(np.max(px[:, 0]) - low[0], np.max(px[:, 1]) - low[1])
    cell = max(cell_px, extent / most_cells)
    columns, rows = 1, 1
    column = np.empty(len(px), np.int64)
    row = np.empty(len(px), np.int64)
    for i in range(len(px)):
        column[i] = int((px[i, 0] - low[0]) / cell)
        row[i] = int((px[i, 1] - low[1]) / cell)
        columns, rows = max(columns, column[i] + 1), max(rows, row[i] + 1)
    starts = np.zeros(columns * rows + 1, np.int64)
    for i in range(len(px)):
        starts[row[i] * columns + column[i] + 1] += 1
    for n in range(columns * rows):
        starts[n + 1] += starts[n]
    filled = starts[:-1].copy()
    order = np.empty(len(px), np.int64)
    for i in range(len(px)):
        n = row[i] * columns + column[i]
        order[filled[n]] = i
        filled[n] += 1
    return low, cell, columns, rows, order, starts


@inlined
def _one_to_one(nearest: Ints, distance: Ints, owner: Ints) -> tuple[Ints, Ints, Ints]:
    """Queries that own the target nearest to them, these targets, and the distances."""
    kept = np.zeros(len(nearest), np.bool_)
    for q in range(len(nearest)):
        kept[q] = nearest[q] >= 0 and owner[nearest[q]] == q
    return np.flatnonzero(kept), nearest[kept], distance[kept]


@compiled
def match(
    px: Floats,
    covariance_px: Floats,
    level: Ints,
    landmark_words: Words,
    grid_low: Floats,
    grid_cell: float,
    grid_shape: tuple[int, int],
    grid_order: Ints,
    grid_starts: Ints,
    feature_px: Floats,
    feature_level: Ints,
    feature_words: Words,
    level_sigma_px: Floats,
    radius_px: float,
    max_px: float,
    sigmas: float,
    chi2: float,
    max_distance: int,
    ratio: float,
) -> tuple[Ints, Ints, Ints]:
    """Match expected landmarks ``(N,)`` to features ``(M,)``.

    Args:
        landmark_words, feature_words: descriptors as 64-bit words.
        grid_shape: columns and rows.
        level_sigma_px: deviation of a feature at each level.

    Returns:
        Indices of landmarks among those expected, of features, and descriptor distances, one to one.
    """
    columns, rows = grid_shape
    words = feature_words.shape[1]
    nearest = np.full(len(px), -1, np.int64)
    nearest_distance = np.empty(len(px), np.int64)
    owner = np.full(len(feature_px), -1, np.int64)
    for q in range(len(px)):
        pose_px = radius_px * level_sigma_px[level[q]]
        S00, S01, S11 = covariance_px[q, 0, 0], covariance_px[q, 0, 1], covariance_px[q, 1, 1]
        half_trace = 0.5 * (S00 + S11)
        largest = half_trace + math.sqrt(max(half_trace * half_trace - (S00 * S11 - S01 * S01), 0.0))
        reach = min(pose_px + sigmas * math.sqrt(largest), max_px)
        # the ellipse of the pose's error plus the point's own, a du^2 + b du dv + c dv^2 < 1
        pose_variance = pose_px * pose_px / chi2
        along_u, along_v = S00 + pose_variance, S11 + pose_variance
        scale = chi2 * (along_u * along_v - S01 * S01)
        a, b, c = along_v / scale, -2.0 * S01 / scale, along_u / scale
        half_u, half_v = min(math.sqrt(chi2 * along_u), reach), min(math.sqrt(chi2 * along_v), reach)
        u, v = px[q, 0], px[q, 1]
        left, right = (u - half_u - grid_low[0]) / grid_cell, (u + half_u - grid_low[0]) / grid_cell
        top, bottom = (v - half_v - grid_low[1]) / grid_cell, (v + half_v - grid_low[1]) / grid_cell
        if not (right >= 0.0 and bottom >= 0.0 and left < columns and top < rows):
            continue
        first_column, last_column = int(max(left, 0.0)), int(min(right, columns - 1.0))
        first_row, last_row = int(max(top, 0.0)), int(min(bottom, rows - 1.0))
        best, best_at, second = _NO_SECOND, -1, _NO_SECOND
        for row in range(first_row, last_row + 1):
            begin = grid_starts[row * columns + first_column]
            end = grid_starts[row * columns + last_column + 1]
            for n in range(begin, end):
                t = grid_order[n]
                du, dv = feature_px[t, 0] - u, feature_px[t, 1] - v
                if du * du + dv * dv > reach * reach or abs(feature_level[t] - level[q]) > 1:
                    continue
                if not (a * du + b * dv) * du + c * dv * dv < 1.0:
                    continue
                distance = 0
                for w in range(words):
                    distance += _bits(landmark_words[q, w] ^ feature_words[t, w])
                if distance < best or (distance == best and t < best_at):
                    best, best_at, second = distance, t, best
                elif distance < second:
                    second = distance
        if best_at < 0 or best > max_distance or best > ratio * second:
            continue
        nearest[q], nearest_distance[q] = best_at, best
        other = owner[best_at]
        if other < 0 or best < nearest_distance[other]:
            owner[best_at] = q
    return _one_to_one(nearest, nearest_distance, owner)


def load() -> None:
    """Compile everything here, or read it from the cache."""
    px, ids, one, words = np.ones((1, 2)), np.zeros(1, np.int64), np.ones(1), np.zeros((4, 4), np.uint64)
    low, cell, columns, rows, order, starts = grid(px, 8.0, 8)
    shape = columns, rows
    match(
        px, np.ones((1, 2, 2)), ids, words, low, cell, shape, order, starts, px, ids, words, one,
        4.0, 30.0, 3.0, 9.0, 64, 0.8,
    )  # fmt: skip
    nearest(words, words)
    mutual(words, words, 64, 0.8)
