# SPDX-License-Identifier: Apache-2.0
"""Resampling of frames in blocks, since frames that follow each other err together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def block_resamples(
    count: int, *, resamples: int = 400, block: int | None = None, seed: int = 0
) -> NDArray[np.int64]:
    """Indices ``(resamples, count)`` into ``count`` frames in order of time.

    The circular block bootstrap (Politis and Romano 1992): blocks of ``block`` frames that
    follow each other are drawn with replacement, the last frame being followed by the
    first. A statistic's standard deviation over the rows is its standard error.

    Args:
        block: frames in a block; None takes the square root of ``count``, which grows with
            it and still leaves as many blocks as a block has frames.

    Raises:
        ValueError: ``count``, ``resamples`` or ``block`` is not positive.
    """
    size = max(1, math.isqrt(count)) if block is None else block
    if min(count, resamples, size) < 1:
        raise ValueError(
            f"need positive numbers, got {count} frames, {resamples} resamples, blocks of {size}"
        )
    blocks = -(-count // size)
    starts = np.random.default_rng(seed).integers(0, count, (resamples, blocks))
    rows = (starts[:, :, None] + np.arange(size)) % count
    return rows.reshape(resamples, -1)[:, :count]
