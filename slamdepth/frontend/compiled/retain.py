# SPDX-License-Identifier: Apache-2.0
"""The best keypoints in the order that OpenCV leaves them in, compiled.

``cv::KeyPointsFilter::retainBest`` calls ``std::nth_element`` and ``std::partition``. How they order elements
depends on the C++ library that OpenCV was built with. GNU's is quickselect by the median of three, with an
insertion sort of the last three elements.
"""

from __future__ import annotations

import numpy as np

from slamdepth.frontend.compiled.jit import compiled, inlined
from slamdepth.typing import Floats32, Ints


@inlined
def _swap(score: Floats32, order: Ints, i: int, j: int) -> None:
    score[i], score[j] = score[j], score[i]
    order[i], order[j] = order[j], order[i]


@inlined
def _median_first(score: Floats32, order: Ints, first: int, last: int) -> None:
    """Swap the median of the second, the middle and the last element with the first."""
    a, b, c = first + 1, first + (last - first) // 2, last - 1
    if score[a] > score[b]:
        middle = b if score[b] > score[c] else (c if score[a] > score[c] else a)
    else:
        middle = a if score[a] > score[c] else (c if score[b] > score[c] else b)
    _swap(score, order, first, middle)


@inlined
def _split(score: Floats32, order: Ints, first: int, last: int) -> int:
    """Move what is greater than the first element before what is less; returns where that begins."""
    pivot = score[first]
    i, j = first + 1, last
    while True:
        while score[i] > pivot:
            i += 1
        j -= 1
        while pivot > score[j]:
            j -= 1
        if i >= j:
            return i
        _swap(score, order, i, j)
        i += 1


@inlined
def _select(score: Floats32, order: Ints, nth: int) -> bool:
    """``std::nth_element``, greatest first; False where it would go on with a heap."""
    first, last = 0, len(score)
    depth = 0
    while last >> (depth + 1):
        depth += 1
    depth *= 2
    while last - first > 3:
        if depth == 0:
            return False
        depth -= 1
        _median_first(score, order, first, last)
        cut = _split(score, order, first, last)
        if cut <= nth:
            first = cut
        else:
            last = cut
    for i in range(first + 1, last):
        j = i
        while j > first and score[j] > score[j - 1]:
            _swap(score, order, j, j - 1)
            j -= 1
    return True


@inlined
def _partition(score: Floats32, order: Ints, first: int, least: float) -> int:
    """``std::partition`` from ``first`` on; returns where the elements that are less than ``least`` begin."""
    last = len(score)
    while True:
        while first != last and score[first] >= least:
            first += 1
        if first == last:
            return first
        last -= 1
        while first != last and not score[last] >= least:
            last -= 1
        if first == last:
            return first
        _swap(score, order, first, last)
        first += 1


@compiled
def best_of_levels(score: Floats32, ends: Ints, most: Ints) -> tuple[bool, Ints]:
    """Indices of the best keypoints of each level, ties with the last one included, as OpenCV orders them.

    Args:
        score: ``(N,)``, level by level; ends: where each level's keypoints end; ``most`` of them to keep.

    Returns:
        False where the order is not known, and the indices.
    """
    kept = np.empty(len(score), np.int64)
    n, begin = 0, 0
    is_known = True
    for level in range(len(ends)):
        of_level = score[begin : ends[level]].copy()
        order = np.arange(begin, ends[level])
        end = len(order)
        if end > most[level]:
            end = 0
            if most[level] > 0:
                is_known &= _select(of_level, order, most[level] - 1)
                end = _partition(of_level, order, most[level], of_level[most[level] - 1])
        kept[n : n + end] = order[:end]
        n += end
        begin = ends[level]
    return is_known, kept[:n].copy()
