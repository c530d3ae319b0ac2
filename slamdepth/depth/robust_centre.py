# SPDX-License-Identifier: Apache-2.0
"""The centre of numbers some of which are wrong."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

_MOST = 1000


def robust_centre(values: Floats) -> float:
    """The median of the means of all pairs (Hodges and Lehmann 1963).

    It bears 29 % of outliers, and varies little more than the mean where errors are Gaussian, where the
    median varies by a quarter more. Of many values only so many are taken, evenly.

    Args:
        values: ``(N,)`` finite, at least one.
    """
    some = values[:: -(-len(values) // _MOST)]
    i, j = np.triu_indices(len(some))
    return float(np.median((some[i] + some[j]) / 2.0))
