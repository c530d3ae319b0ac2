# SPDX-License-Identifier: Apache-2.0
"""Pauses of a path: plots break lines there, where frames were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def gap_ends(timestamps_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices before which a curve must be broken: pauses longer than 2.5 times the median spacing."""
    spacing = np.diff(timestamps_s)
    return np.flatnonzero(spacing > 2.5 * np.median(spacing)) + 1 if len(spacing) else np.empty(0, np.int64)
