# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals of statistics over the frames of a sequence, which are correlated in time.

Frames are resampled in blocks of neighbours, so that their correlation stays in the sample: the
moving-block bootstrap (Kuensch, Annals of Statistics 1989) with blocks that wrap
around, so that every frame is drawn as often (Politis and Romano 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


FEWEST_FRAMES = 8
"""No interval is given for fewer frames."""


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % confidence interval.

    Attributes:
        value: over all frames; NaN where no frame has the figure.
        low, high: bounds, or None where there are too few frames.
    """

    value: float
    low: float | None = None
    high: float | None = None


def block_length(frames: int) -> int:
    """Frames per block: the square root of their number, rounded up.

    Blocks grow with the sequence, and there are about as many of them as each has frames.
    """
    return math.ceil(math.sqrt(max(1, frames)))


def block_resamples(
    count: int, *, resamples: int = 400, block: int | None = None, seed: int = 0
) -> NDArray[np.int64]:
    """Indices ``(resamples, count)`` into ``count`` frames in order of time.

    Blocks of ``block`` frames that follow each other are drawn with replacement, the last
    frame being followed by the first. A statistic's standard deviation over the rows is
    its standard error.

    Args:
        block: frames in a block; default: :func:`block_length`.

    Raises:
        ValueError: ``count``, ``resamples`` or ``block`` is not positive.
    """
    size = block_length(count) if block is None else block
    if min(count, resamples, size) < 1:
        raise ValueError(
            f"need positive numbers, got {count} frames, {resamples} resamples, blocks of {size}"
        )
    starts = np.random.default_rng(seed).integers(0, count, (resamples, math.ceil(count / size)))
    rows = (starts[:, :, None] + np.arange(size)) % count
    return rows.reshape(resamples, -1)[:, :count]


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
        values: ``(N,)`` figures of frames in order of time; NaN where a frame has none. NaNs are
            left out first, so a block may span a gap.
        statistic: of ``(..., N)`` over the last axis, as ``np.std``; default: the mean.
        block: frames per block; default: :func:`block_length`.
        draws: samples drawn.
        seed: of the draws.
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    of = statistic or _mean
    if len(known) == 0:
        return Interval(math.nan)
    value = float(of(known))
    if len(known) < FEWEST_FRAMES:
        return Interval(value)
    chosen = block_resamples(len(known), resamples=draws, block=block, seed=seed)
    low, high = np.percentile(of(known[chosen]), (2.5, 97.5))
    return Interval(value, float(low), float(high))


def spread(values: Floats) -> Floats:
    """Standard deviation over the last axis, as a statistic for :func:`interval`."""
    return np.asarray(np.std(values, axis=-1))


def _mean(values: Floats) -> Floats:
    return np.asarray(np.mean(values, axis=-1))
