# SPDX-License-Identifier: Apache-2.0
"""Distances between descriptors, and the thresholds of a match.

A distance is an integer from 0 to :data:`FARTHEST` for every kind of descriptor, so that matching
sorts pairs by one packed number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from slamdepth.frontend.compiled import loops
from slamdepth.typing import Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]
    Descriptors = NDArray[Any]

FARTHEST = 1023
"""The largest distance; larger ones are clipped to it."""

_BLOCK = 16  # descriptors against 2,000 others: the block stays in a core's second-level cache
_UNIT = FARTHEST / 2.0  # two unit vectors are at most 2 apart


class DescriptorMetric(Protocol):
    """The distance between two descriptors of one kind, and its thresholds.

    Attributes:
        max_distance: largest distance of a match.
        strict_distance: largest distance where a wrong match would stay in the map.
    """

    @property
    def max_distance(self) -> int: ...

    @property
    def strict_distance(self) -> int: ...

    def empty(self) -> Descriptors:
        """No descriptors, ``(0, D)``, of the right width and type."""
        ...

    def between(self, a: Descriptors, b: Descriptors) -> Ints:
        """Distances ``(N,)`` of descriptors ``(N, D)`` row by row."""
        ...

    def table(self, a: Descriptors, b: Descriptors) -> NDArray[np.uint16]:
        """Distances ``(N, M)`` of all descriptors ``(N, D)`` from all ``(M, D)``."""
        ...


@dataclass(frozen=True)
class Hamming:
    """Hamming distance of binary descriptors ``(N, size)`` uint8.

    Attributes:
        size: bytes per descriptor; a multiple of 8 is fastest, see :func:`whole_words`.
        max_distance, strict_distance: see :class:`DescriptorMetric`.
    """

    size: int = 32
    max_distance: int = 64
    strict_distance: int = 50

    def empty(self) -> Bytes:
        return np.zeros((0, self.size), dtype=np.uint8)

    def between(self, a: Bytes, b: Bytes) -> Ints:
        distance = hamming(a, b)
        return distance if 8 * self.size <= FARTHEST else np.minimum(distance, FARTHEST)

    def table(self, a: Bytes, b: Bytes) -> NDArray[np.uint16]:
        table = hamming_table(a, b)
        return table if 8 * self.size <= FARTHEST else np.minimum(table, np.uint16(FARTHEST))


@dataclass(frozen=True)
class UnitL2:
    """Euclidean distance of unit vectors ``(N, size)`` float32, in steps of 2 / 1023.

    Attributes:
        size: numbers of a descriptor.
        max_l2, strict_l2: the thresholds as they are in the literature, 0 to 2.
    """

    size: int
    max_l2: float
    strict_l2: float

    @property
    def max_distance(self) -> int:
        return int(self.max_l2 * _UNIT)

    @property
    def strict_distance(self) -> int:
        return int(self.strict_l2 * _UNIT)

    def empty(self) -> Floats32:
        return np.zeros((0, self.size), dtype=np.float32)

    def between(self, a: Floats32, b: Floats32) -> Ints:
        return _steps(np.einsum("ij,ij->i", a, b)).astype(np.int64)

    def table(self, a: Floats32, b: Floats32) -> NDArray[np.uint16]:
        return _steps(a @ b.T).astype(np.uint16)


def _steps(cosine: Floats32) -> Floats32:
    """Distances of unit vectors from their inner products, in whole steps of 2 / 1023."""
    steps: Floats32 = np.rint(np.sqrt(np.clip(2.0 - 2.0 * cosine, 0.0, 4.0)) * np.float32(_UNIT))
    return steps


ORB = Hamming(32, 64, 50)
"""The metric of ORB's 256 bits."""


def has_words(metric: DescriptorMetric) -> bool:
    """Whether the distance is the number of bits in which two descriptors differ."""
    return isinstance(metric, Hamming) and 8 * metric.size <= FARTHEST


def whole_words(descriptors: Bytes) -> Bytes:
    """Binary descriptors ``(..., D)`` padded with zeros to a multiple of 8 bytes."""
    rest = -descriptors.shape[-1] % 8
    if rest == 0:
        return np.ascontiguousarray(descriptors)
    filling = [(0, 0)] * (descriptors.ndim - 1) + [(0, rest)]
    return np.pad(descriptors, filling)


def hamming(a: Bytes, b: Bytes) -> Ints:
    """Hamming distances of descriptors ``(..., D)`` uint8 of any length, row by row."""
    xor = whole_words(a).view(np.uint64) ^ whole_words(b).view(np.uint64)
    bits = np.bitwise_count(xor)
    total: Ints = bits[..., 0].astype(np.int64)
    for word in range(1, bits.shape[-1]):  # additions of columns beat a sum along the short axis
        total += bits[..., word]
    return total


def hamming_table(a: Bytes, b: Bytes) -> NDArray[np.uint16]:
    """Hamming distances ``(N, M)`` of all descriptors ``(N, D)`` from all ``(M, D)``."""
    table = np.empty((len(a), len(b)), dtype=np.uint16)
    for start, distances in _hamming_blocks(a, b):
        table[start : start + len(distances)] = distances
    return table


def hamming_nearest(a: Bytes, b: Bytes) -> NDArray[np.intp]:
    """Index ``(N,)`` of the descriptor in ``b (M, D)`` that is nearest to each in ``a (N, D)``.

    Ties go to the lowest index. Memory does not grow with ``N`` times ``M``.
    """
    if (fast := loops()) is not None and len(b):
        columns = np.ascontiguousarray(whole_words(b).view(np.uint64).T)
        return np.asarray(fast.matching.nearest(whole_words(a).view(np.uint64), columns), dtype=np.intp)
    index = np.empty(len(a), dtype=np.intp)
    for start, distances in _hamming_blocks(a, b):
        index[start : start + len(distances)] = distances.argmin(axis=1)
    return index


def _hamming_blocks(a: Bytes, b: Bytes) -> Iterator[tuple[int, NDArray[np.uint16]]]:
    """Hamming distances of ``a (N, D)`` from ``b (M, D)``, block by block.

    Yields:
        Index of the block's first descriptor in ``a``, and distances ``(n, M)`` in a reused buffer.
    """
    wide_a = whole_words(a).view(np.uint64)
    wide_b = np.ascontiguousarray(whole_words(b).view(np.uint64).T)
    differing = np.empty((_BLOCK, len(b)), dtype=np.uint64)
    bits = np.empty((_BLOCK, len(b)), dtype=np.uint8)
    distances = np.empty((_BLOCK, len(b)), dtype=np.uint16)  # 256 does not fit uint8
    for start in range(0, len(a), _BLOCK):
        block = wide_a[start : start + _BLOCK]
        n = len(block)
        distances[:n] = 0
        for word, column in enumerate(wide_b):
            np.bitwise_xor(block[:, word, None], column, out=differing[:n])
            np.bitwise_count(differing[:n], out=bits[:n])
            distances[:n] += bits[:n]
        yield start, distances[:n]
