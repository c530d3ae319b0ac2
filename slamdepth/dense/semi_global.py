# SPDX-License-Identifier: Apache-2.0
"""Semi-global matching: a smooth choice of one label a pixel (Hirschmueller, PAMI 2008)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.typing import Bytes, Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

_STEP = np.float32(0.05)  # cost of a change by one label
_JUMP = np.float32(0.6)  # cost of any other change, where the image is even
_EDGE_GREY = np.float32(12.0)  # a step of so many grey values makes a jump cheaper by e


def aggregate(cost: Floats32, grey: Bytes) -> Floats32:
    """Sum the costs of the best paths from eight directions.

    A label is a ratio to the prediction, so equal labels follow the relief that is predicted.

    Args:
        cost: ``(L, h, w)``.
        grey: ``(h, w)`` of the same pixels; jumps are cheaper at its edges.

    Returns:
        ``(h, w, L)`` float32.
    """
    rows = np.ascontiguousarray(cost.transpose(1, 2, 0))  # (h, w, L)
    total = np.zeros_like(rows)
    for slope in (0, 1, -1):
        _sweep(rows, total, grey, slope)
        _sweep(rows[::-1], total[::-1], grey[::-1], slope)
    columns, sums = np.ascontiguousarray(rows.transpose(1, 0, 2)), np.zeros_like(rows.transpose(1, 0, 2))
    _sweep(columns, sums, grey.T, 0)
    _sweep(columns[::-1], sums[::-1], grey.T[::-1], 0)
    total += sums.transpose(1, 0, 2)
    return total


def _sweep(cost: Floats32, total: Floats32, grey: Bytes, slope: int) -> None:
    """Add the costs of paths that go from each row to the next, ``slope`` pixels to the right."""
    height, width, labels = cost.shape
    grey = grey.astype(np.float32)
    # a path that enters at the side starts there: it has no predecessor
    inner = slice(max(0, slope), width + min(0, slope))
    before = slice(max(0, -slope), width + min(0, -slope))
    last = cost[0].copy()
    total[0] += last
    now = np.empty_like(last)
    padded = np.full((width, labels + 2), np.inf, np.float32)
    for y in range(1, height):
        now[:] = cost[y]
        padded[:, 1:-1] = last
        least = last.min(axis=1)
        jump = _JUMP * np.exp(-np.abs(grey[y, inner] - grey[y - 1, before]) / _EDGE_GREY)
        best = np.minimum(padded[:, :-2], padded[:, 2:])[before]
        best += _STEP
        np.minimum(best, last[before], out=best)
        np.minimum(best, (least[before] + np.maximum(jump, _STEP))[:, None], out=best)
        best -= least[before, None]
        now[inner] += best
        total[y] += now
        last, now = now, last


def best_label(total: Floats32) -> tuple[Ints, Floats32]:
    """The label of least cost, and the minimum of a parabola through it and its neighbours.

    Args:
        total: ``(h, w, L)``, of :func:`aggregate`.

    Returns:
        ``(label (h, w), position (h, w))``; the second is within half a label of the first.
    """
    last = total.shape[2] - 1
    label = total.argmin(axis=2)
    middle = np.clip(label, 1, last - 1)
    below, at, above = (_at(total, middle + step) for step in (-1, 0, 1))
    bend = below - 2.0 * at + above
    shift = np.where(bend > 1e-6, 0.5 * (below - above) / np.maximum(bend, 1e-6), 0.0)
    return label, np.asarray(middle + np.clip(shift, -0.5, 0.5), np.float32)


def _at(total: Floats32, label: Ints) -> NDArray[np.float32]:
    return np.take_along_axis(total, label[..., None], axis=2)[..., 0]
