# SPDX-License-Identifier: Apache-2.0
"""A robust estimate of the centre of a sample with outliers."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

_MAX_VALUES = 1000


def robust_centre(values: Floats) -> float:
    """The Hodges-Lehmann estimate: the median of the means of all pairs (Hodges and Lehmann 1963).

    It has a breakdown point of 29 %. For Gaussian errors its standard deviation is little above that of the
    mean, while that of the median is a quarter above. Of more than 1,000 values, at most 1,000 evenly spaced
    ones are used.

    Args:
        values: ``(N,)`` finite, at least one.
    """
    sample = values[:: -(-len(values) // _MAX_VALUES)]
    i, j = np.triu_indices(len(sample))
    return float(np.median((sample[i] + sample[j]) / 2.0))
