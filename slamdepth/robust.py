# SPDX-License-Identifier: Apache-2.0
"""Robust statistics."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

_GAUSSIAN = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_deviation(values: Floats, centre: float | None = None) -> float:
    """Standard deviation of Gaussian ``values (N,)`` by their median absolute deviation; breaks down at 50 %.

    Args:
        values: at least one.
        centre: that they deviate from; None: their median.
    """
    middle = np.median(values) if centre is None else centre
    return _GAUSSIAN * float(np.median(np.abs(values - middle)))
