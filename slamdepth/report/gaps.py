# SPDX-License-Identifier: Apache-2.0
"""Where a path pauses, so that no line bridges lost frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def gap_ends(timestamps_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices before which a curve must be broken: pauses of over 2.5 times the usual spacing."""
    spacing = np.diff(timestamps_s)
    return np.flatnonzero(spacing > 2.5 * np.median(spacing)) + 1 if len(spacing) else np.empty(0, np.int64)
