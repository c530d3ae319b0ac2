# SPDX-License-Identifier: Apache-2.0
"""Matching of descriptors, near predicted pixels or over whole images."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.frontend.metric import FARTHEST, ORB, DescriptorMetric, has_words, whole_words
from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MAX_CELLS = 256  # along a side


class PixelGrid:
    """Pixels in a grid of square cells, for fast search of those near given positions.

    Args:
        px: ``(N, 2)`` pixels.
        cell_px: edge of a cell.

    Attributes:
        low: ``(2,)`` lowest pixel; cell: edge of a cell; columns, rows: number of cells.
        order: ``(N,)`` pixels by cell; starts: ``(columns * rows + 1,)`` where each cell starts in it.
        They do not exist where there are no pixels.
    """

    def __init__(self, px: Floats, cell_px: float = 8.0) -> None:
        self._px = px
        if len(px) == 0:
            return
        if (fast := loops()) is not None:
            found = fast.matching.grid(px, cell_px, _MAX_CELLS)
            self.low, self.cell, self.columns, self.rows, self.order, self.starts = found
            return
        self.low = px.min(axis=0)
        self.cell = max(cell_px, float((px.max(axis=0) - self.low).max()) / _MAX_CELLS)
        cell = ((px - self.low) / self.cell).astype(np.int64)
        self.columns, self.rows = (int(n) + 1 for n in cell.max(axis=0))
        flat = cell[:, 1] * self.columns + cell[:, 0]
        self.order = np.argsort(flat, kind="stable")
        counts = np.bincount(flat, minlength=self.columns * self.rows)
        self.starts = np.concatenate([[0], np.cumsum(counts)])

    @property
    def cells(self) -> tuple[Floats, float, tuple[int, int], Ints, Ints]:
        """The attributes, as :func:`slamdepth.frontend.compiled.matching.match` takes them."""
        return self.low, self.cell, (self.columns, self.rows), self.order, self.starts

    @cached_property
    def _sorted_px(self) -> Floats:
        """``px`` by cell, ``(2, N)``."""
        return np.ascontiguousarray(self._px[self.order].T)

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
        if len(query_px) == 0 or len(self._px) == 0:
            empty = np.zeros(0, dtype=np.int64)
            return empty, empty
        # of each query: the columns and rows of cells that its circle may touch
        half = radius_px[:, None] if half_px is None else np.minimum(half_px, radius_px[:, None])
        centre = query_px - self.low
        limit = np.array([self.columns, self.rows]) - 1
        first = np.clip(np.floor((centre - half) / self.cell), 0, limit + 1).astype(np.int64)
        last = np.clip(np.floor((centre + half) / self.cell), -1, limit).astype(np.int64)
        height = np.where(last[:, 0] >= first[:, 0], np.maximum(last[:, 1] - first[:, 1] + 1, 0), 0)
        # a row of cells is one run of the sorted pixels
        query, offset = _expand(height)
        row = (first[query, 1] + offset) * self.columns
        begin, end = self.starts[row + first[query, 0]], self.starts[row + last[query, 0] + 1]
        count = end - begin
        at = _expand_from(begin, count)
        u, v = query_px.T
        sorted_u, sorted_v = self._sorted_px
        du = np.repeat(u.take(query), count) - sorted_u.take(at)
        dv = np.repeat(v.take(query), count) - sorted_v.take(at)
        near = np.flatnonzero(du * du + dv * dv <= np.repeat((radius_px * radius_px).take(query), count))
        return np.repeat(query, count).take(near), self.order.take(at.take(near))


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
    if (fast := loops()) is not None and has_words(metric):
        columns = np.ascontiguousarray(whole_words(b).view(np.uint64).T)
        words = whole_words(a).view(np.uint64)
        found: tuple[Ints, Ints, Ints] = fast.matching.mutual(words, columns, metric.max_distance, ratio)
        return found
    table = metric.table(a, b)
    best = table.argmin(axis=1)
    rows = np.arange(len(a))
    d = table[rows, best].astype(np.int64)
    backward = table.argmin(axis=0)
    table[rows, best] = np.iinfo(table.dtype).max
    second = table.min(axis=1)
    keep = (backward[best] == rows) & (d <= metric.max_distance) & (d <= ratio * second)
    return rows[keep], best[keep], d[keep]
