# SPDX-License-Identifier: Apache-2.0
"""Matching of binary descriptors, near a predicted place or over whole images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]
    Floats = NDArray[np.float64]
    Bytes = NDArray[np.uint8]

MAX_DISTANCE = 64
"""Hamming distance beyond which two ORB descriptors are never one point."""


def hamming(a: Bytes, b: Bytes) -> Ints:
    """Bits that differ between descriptors ``(..., 32)`` uint8, row by row."""
    xor = np.ascontiguousarray(a).view(np.uint64) ^ np.ascontiguousarray(b).view(np.uint64)
    return np.bitwise_count(xor).sum(axis=-1, dtype=np.int64)


def hamming_table(a: Bytes, b: Bytes) -> NDArray[np.int32]:
    """``(N, M)`` bits that differ between all descriptors ``(N, 32)`` and ``(M, 32)``."""
    wa, wb = np.ascontiguousarray(a).view(np.uint64), np.ascontiguousarray(b).view(np.uint64)
    table = np.zeros((len(a), len(b)), dtype=np.int32)
    for word in range(wa.shape[1]):
        table += np.bitwise_count(wa[:, word, None] ^ wb[None, :, word])
    return table


def pairs_within(query_px: Floats, radius_px: Floats, px: Floats) -> tuple[Ints, Ints]:
    """All pairs ``(query, target)`` closer than the query's radius.

    Args:
        query_px: ``(M, 2)``, radius_px: ``(M,)``, px: ``(N, 2)``; pixels.

    Returns:
        Two index arrays of equal length, in no particular order.
    """
    empty = np.zeros(0, dtype=np.int64)
    if len(query_px) == 0 or len(px) == 0:
        return empty, empty
    # one grid for each range of radii: a few far searches must not make all cells large
    parts = []
    lower = 0.0
    for upper in (12.0, 30.0, np.inf):
        chosen = np.flatnonzero((radius_px > lower) & (radius_px <= upper))
        lower = upper
        if len(chosen):
            q, t = _pairs_in_grid(query_px[chosen], radius_px[chosen], px)
            parts.append((chosen[q], t))
    if not parts:
        return empty, empty
    return np.concatenate([q for q, _ in parts]), np.concatenate([t for _, t in parts])


def _pairs_in_grid(query_px: Floats, radius_px: Floats, px: Floats) -> tuple[Ints, Ints]:
    """:func:`pairs_within` over square cells of the largest radius: three rows of cells hold all."""
    cell = max(float(radius_px.max()), 8.0)
    low = px.min(axis=0)
    target_cell = np.floor((px - low) / cell).astype(np.int64) + 1
    columns, rows = target_cell[:, 0].max() + 3, target_cell[:, 1].max() + 3
    flat = target_cell[:, 1] * columns + target_cell[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(columns * rows + 1))
    query_cell = np.floor((query_px - low) / cell).astype(np.int64) + 1
    inside = np.flatnonzero(
        (query_cell[:, 0] >= 0)
        & (query_cell[:, 0] < columns)
        & (query_cell[:, 1] >= 0)
        & (query_cell[:, 1] < rows)
    )
    queries, targets = [], []
    for dy in (-1, 0, 1):
        row = query_cell[inside, 1] + dy
        ok = (row >= 0) & (row < rows)
        rows_ok, q = row[ok], inside[ok]
        left = np.maximum(query_cell[q, 0] - 1, 0)
        right = np.minimum(query_cell[q, 0] + 1, columns - 1)
        begin, end = starts[rows_ok * columns + left], starts[rows_ok * columns + right + 1]
        length = end - begin
        total = int(length.sum())
        offset = np.arange(total) - np.repeat(np.cumsum(length) - length, length)
        queries.append(np.repeat(q, length))
        targets.append(order[offset + np.repeat(begin, length)])
    q, t = np.concatenate(queries), np.concatenate(targets)
    du, dv = query_px[q, 0] - px[t, 0], query_px[q, 1] - px[t, 1]
    near = du * du + dv * dv <= radius_px[q] ** 2
    return q[near], t[near]


def best_matches(
    query: Ints, target: Ints, distance: Ints, *, max_distance: int, ratio: float
) -> tuple[Ints, Ints, Ints]:
    """Reduce scored pairs to a one-to-one matching.

    A query keeps its nearest target when that is near enough and clearly nearer than
    its second (Lowe's ratio); a target wanted by several keeps the nearest.

    Returns:
        ``(query, target, distance)`` sorted by query.
    """
    if len(query) == 0:
        return query, target, distance
    order = np.lexsort((target, distance, query))
    q, t, d = query[order], target[order], distance[order]
    first = np.r_[True, q[1:] != q[:-1]]
    second = np.full(len(q), 1 << 30)
    second[:-1] = np.where(q[1:] == q[:-1], d[1:], 1 << 30)
    keep = first & (d <= max_distance) & (d <= ratio * second)
    q, t, d = q[keep], t[keep], d[keep]
    order = np.lexsort((q, d, t))
    unique = np.r_[True, t[order][1:] != t[order][:-1]] if len(t) else np.zeros(0, dtype=bool)
    kept = np.sort(order[unique])
    return q[kept], t[kept], d[kept]


def match_all(
    a: Bytes, b: Bytes, *, max_distance: int = MAX_DISTANCE, ratio: float = 0.8
) -> tuple[Ints, Ints, Ints]:
    """Mutual nearest neighbours of descriptors ``(N, 32)`` and ``(M, 32)`` with a ratio test.

    Returns:
        ``(index in a, index in b, distance)``.
    """
    empty = np.zeros(0, dtype=np.int64)
    if len(a) == 0 or len(b) < 2:
        return empty, empty, empty
    table = hamming_table(a, b)
    best = table.argmin(axis=1)
    rows = np.arange(len(a))
    d = table[rows, best]
    backward = table.argmin(axis=0)
    second = np.partition(table, 1, axis=1)[:, 1]
    keep = (backward[best] == rows) & (d <= max_distance) & (d <= ratio * second)
    return rows[keep], best[keep], d[keep].astype(np.int64)
