# SPDX-License-Identifier: Apache-2.0
"""Matching of descriptors, near predicted pixels or over whole images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.metric import FARTHEST, ORB, DescriptorMetric
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MAX_CELLS = 256  # along a side


class PixelGrid:
    """Pixels in a grid of square cells, for fast search of those near given positions.

    Args:
        px: ``(N, 2)`` pixels.
        cell_px: edge of a cell.
    """

    def __init__(self, px: Floats, cell_px: float = 8.0) -> None:
        self._count = len(px)
        if len(px) == 0:
            return
        self._low = px.min(axis=0)
        self._cell = max(cell_px, float((px.max(axis=0) - self._low).max()) / _MAX_CELLS)
        cell = ((px - self._low) / self._cell).astype(np.int64)
        self._columns, self._rows = (int(n) + 1 for n in cell.max(axis=0))
        flat = cell[:, 1] * self._columns + cell[:, 0]
        self._order = np.argsort(flat, kind="stable")
        self._u, self._v = px[self._order].T.copy()
        counts = np.bincount(flat, minlength=self._columns * self._rows)
        self._starts = np.concatenate([[0], np.cumsum(counts)])

    def pairs_within(
        self, query_px: Floats, radius_px: Floats, half_px: Floats | None = None
    ) -> tuple[Ints, Ints]:
        """All pairs ``(query, pixel)`` closer than the query's radius.

        Args:
            query_px: ``(M, 2)``; radius_px: ``(M,)`` pixels.
            half_px: ``(M, 2)`` half extent of the search along each axis; pairs beyond may be left out.

        Returns:
            Two index arrays of equal length, sorted by query.
        """
        if len(query_px) == 0 or self._count == 0:
            empty = np.zeros(0, dtype=np.int64)
            return empty, empty
        # of each query: the columns and rows of cells that its circle may touch
        half = radius_px[:, None] if half_px is None else np.minimum(half_px, radius_px[:, None])
        centre = query_px - self._low
        limit = np.array([self._columns, self._rows]) - 1
        first = np.clip(np.floor((centre - half) / self._cell), 0, limit + 1).astype(np.int64)
        last = np.clip(np.floor((centre + half) / self._cell), -1, limit).astype(np.int64)
        height = np.where(last[:, 0] >= first[:, 0], np.maximum(last[:, 1] - first[:, 1] + 1, 0), 0)
        # a row of cells is one run of the sorted pixels
        query, offset = _expand(height)
        row = (first[query, 1] + offset) * self._columns
        begin, end = self._starts[row + first[query, 0]], self._starts[row + last[query, 0] + 1]
        count = end - begin
        at = _expand_from(begin, count)
        u, v = query_px.T
        du = np.repeat(u.take(query), count) - self._u.take(at)
        dv = np.repeat(v.take(query), count) - self._v.take(at)
        near = np.flatnonzero(du * du + dv * dv <= np.repeat((radius_px * radius_px).take(query), count))
        return np.repeat(query, count).take(near), self._order.take(at.take(near))


def _expand(lengths: Ints) -> tuple[Ints, Ints]:
    """Each item repeated ``lengths`` times: its index, and 0, 1, 2 ... within it."""
    return np.repeat(np.arange(len(lengths)), lengths), _expand_from(np.zeros_like(lengths), lengths)


def _expand_from(first: Ints, lengths: Ints) -> Ints:
    """The runs of integers ``first, first + 1, ...`` of each item, one after the other."""
    end = np.cumsum(lengths)
    numbers = np.repeat(first - (end - lengths), lengths)
    numbers += np.arange(len(numbers))
    return numbers


def best_matches(
    query: Ints, target: Ints, distance: Ints, *, max_distance: int, ratio: float
) -> tuple[Ints, Ints, Ints]:
    """Reduce scored pairs to a one-to-one matching.

    A query keeps its nearest target where that is near enough and clearly nearer than the
    second (Lowe's ratio test); a target of several queries keeps the nearest.

    Args:
        query, target: ``(P,)`` indices below 2^22 and 2^30.
        distance: ``(P,)`` at most :data:`slamdepth.frontend.metric.FARTHEST`.
        ratio: nearest over second nearest, at most; not above one.

    Returns:
        ``(query, target, distance)`` sorted by query.
    """
    # a pair beyond max_distance / ratio is neither a match nor a second that refuses one
    near = np.flatnonzero(ratio * distance <= max_distance)
    query, target, distance = query.take(near), target.take(near), distance.take(near)
    if len(query) == 0:
        return query, target, distance
    # three numbers in one: sorting integers is several times faster than sorting by three keys
    key = np.sort((query << 40) | (distance << 30) | target)
    q, d, t = key >> 40, (key >> 30) & FARTHEST, key & 0x3FFFFFFF
    first = np.r_[True, q[1:] != q[:-1]]
    second = np.full(len(q), 1 << 30)
    second[:-1] = np.where(q[1:] == q[:-1], d[1:], 1 << 30)
    keep = first & (d <= max_distance) & (d <= ratio * second)
    q, t, d = q[keep], t[keep], d[keep]
    if len(q) == 0:
        return q, t, d
    by_target = np.sort((t << 40) | (d << 30) | q)
    unique = np.r_[True, (by_target[1:] >> 40) != (by_target[:-1] >> 40)]
    kept = np.sort(by_target[unique] & 0x3FFFFFFF)  # the queries, each of which occurs once
    at = np.searchsorted(q, kept)
    return q[at], t[at], d[at]


def match_all(
    a: NDArray[Any], b: NDArray[Any], *, metric: DescriptorMetric = ORB, ratio: float = 0.8
) -> tuple[Ints, Ints, Ints]:
    """Mutual nearest neighbours of descriptors ``(N, D)`` and ``(M, D)`` with a ratio test.

    Returns:
        ``(index in a, index in b, distance)``.
    """
    empty = np.zeros(0, dtype=np.int64)
    if len(a) == 0 or len(b) < 2:
        return empty, empty, empty
    table = metric.table(a, b)
    best = table.argmin(axis=1)
    rows = np.arange(len(a))
    d = table[rows, best].astype(np.int64)
    backward = table.argmin(axis=0)
    table[rows, best] = np.iinfo(table.dtype).max
    second = table.min(axis=1)
    keep = (backward[best] == rows) & (d <= metric.max_distance) & (d <= ratio * second)
    return rows[keep], best[keep], d[keep]
