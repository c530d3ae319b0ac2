# SPDX-License-Identifier: Apache-2.0
"""Association of measurements by time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def associate(
    first_s: NDArray[np.float64], second_s: NDArray[np.float64], max_difference_s: float
) -> list[tuple[int, int]]:
    """Pair times one to one, closest pairs first, as TUM's ``associate.py`` does.

    Args:
        first_s: ``(N,)`` increasing seconds.
        second_s: ``(M,)`` increasing seconds.
        max_difference_s: pairs this far apart or farther are left out.

    Returns:
        Pairs ``(index in first, index in second)`` in order of the first.
    """
    low = np.searchsorted(second_s, first_s - max_difference_s, side="left")
    high = np.searchsorted(second_s, first_s + max_difference_s, side="right")
    counts = high - low
    i = np.repeat(np.arange(len(first_s)), counts)
    j = np.arange(len(i)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
    difference_s = np.abs(first_s[i] - second_s[j])

    first_taken = np.zeros(len(first_s), dtype=bool)
    second_taken = np.zeros(len(second_s), dtype=bool)
    pairs: list[tuple[int, int]] = []
    for k in np.lexsort((j, i, difference_s)):
        if difference_s[k] < max_difference_s and not first_taken[i[k]] and not second_taken[j[k]]:
            first_taken[i[k]] = second_taken[j[k]] = True
            pairs.append((int(i[k]), int(j[k])))
    return sorted(pairs)
