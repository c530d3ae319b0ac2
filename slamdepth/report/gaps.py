# SPDX-License-Identifier: Apache-2.0
"""Pauses of a path: plots break lines there, where frames were lost or are in another map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


def gap_ends(timestamps_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices before which a curve must be broken: pauses longer than 2.5 times the median spacing."""
    spacing = np.diff(timestamps_s)
    return np.flatnonzero(spacing > 2.5 * np.median(spacing)) + 1 if len(spacing) else np.empty(0, np.int64)


def with_gaps(times: Floats, values: Floats) -> Floats:
    """Rows ``values (N, D)`` with a row of NaN in each pause, so that no line bridges lost frames."""
    return np.insert(values.astype(np.float64), gap_ends(times), np.nan, axis=0)
