# SPDX-License-Identifier: Apache-2.0
"""Intervals of a figure over the frames of a sequence, whose neighbours are alike.

Frames are drawn again in blocks of neighbours, so that what they have in common stays in the
sample: the moving-block bootstrap (Kuensch, Annals of Statistics 1989) with blocks that wrap
around, so that every frame is drawn as often (Politis and Romano 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

FEWEST_FRAMES = 8
"""Of fewer frames no interval is given."""


@dataclass(frozen=True)
class Interval:
    """A figure and where it lies with 95 % confidence.

    Attributes:
        value: over all frames; NaN where no frame has the figure.
        low, high: bounds, or None where there are too few frames to tell.
    """

    value: float
    low: float | None = None
    high: float | None = None


def block_length(frames: int) -> int:
    """Frames a block: the root of their number, rounded up."""
    return max(1, math.ceil(math.sqrt(frames)))


def interval(
    values: Floats,
    statistic: Callable[[Floats], Floats] | None = None,
    *,
    block: int | None = None,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """The 95 % percentile interval of a statistic over frames.

    Args:
        values: ``(N,)`` figures of frames in order of time; NaN where a frame has none. Those
            are left out first, so blocks may then span a gap.
        statistic: of ``(..., N)`` over the last axis, as ``np.std``; default: the mean.
        block: frames a block; default: :func:`block_length`.
        draws: samples drawn.
        seed: of the draws; the same gives the same bounds.
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    of = statistic or _mean
    if len(known) == 0:
        return Interval(math.nan)
    value = float(of(known))
    if len(known) < FEWEST_FRAMES:
        return Interval(value)
    length = min(block or block_length(len(known)), len(known))
    blocks = math.ceil(len(known) / length)
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, len(known), size=(draws, blocks, 1))
    chosen = ((starts + np.arange(length)) % len(known)).reshape(draws, -1)[:, : len(known)]
    low, high = np.percentile(of(known[chosen]), (2.5, 97.5))
    return Interval(value, float(low), float(high))


def spread(values: Floats) -> Floats:
    """Standard deviation over the last axis, as a statistic for :func:`interval`."""
    return np.asarray(np.std(values, axis=-1))


def _mean(values: Floats) -> Floats:
    return np.asarray(np.mean(values, axis=-1))
