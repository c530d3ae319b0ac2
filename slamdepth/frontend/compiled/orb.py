# SPDX-License-Identifier: Apache-2.0
"""ORB's corner scores, orientations and descriptors, compiled; the same to the last bit as OpenCV's.

Images of a pyramid are one array ``(P,)`` uint8, level after level and row by row.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.frontend.compiled.jit import compiled, inlined
from slamdepth.typing import Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

_BLOCK = 7  # edge of the window of a Harris score
_LANES = 8  # columns that are computed, as many as a vector register holds; the last one is dropped
_HALF_PATCH = 15
_REACH = 20  # that no pixel of the rotated pattern is beyond, along either axis
_HARRIS_K = np.float32(0.04)
_UNIT = np.float32(1.0) / (np.float32(4 * _BLOCK) * np.float32(255.0))
_UNIT_4 = _UNIT * _UNIT * _UNIT * _UNIT
_TO_DEGREES = np.float32(180.0 / math.pi)
_TO_RADIANS = np.float32(math.pi / 180.0)
_P1 = np.float32(0.9997878412794807) * _TO_DEGREES
_P3 = np.float32(-0.3258083974640975) * _TO_DEGREES
_P5 = np.float32(0.1555786518463281) * _TO_DEGREES
_P7 = np.float32(-0.04432655554792128) * _TO_DEGREES
_EPSILON = np.float32(2.220446049250313e-16)
_90, _180, _360 = np.float32(90.0), np.float32(180.0), np.float32(360.0)


@compiled
def harris(images: Bytes, starts: Ints, widths: Ints, level: Ints, xy: Ints) -> Floats32:
    """Harris scores ``(N,)`` of corners at ``xy (N, 2)``, pixels of their levels ``(N,)``.

    Args:
        starts, widths: of each level in ``images``.
    """
    out = np.empty(len(level), np.float32)
    # of each row of the window: differences along it, and sums with the middle counted twice
    difference = np.empty((_BLOCK + 2, _LANES), np.int32)
    total = np.empty((_BLOCK + 2, _LANES), np.int32)
    sums = np.empty((3, _LANES), np.int32)
    half = _BLOCK // 2 + 1
    for n in range(len(level)):
        step = widths[level[n]]
        corner = starts[level[n]] + (xy[n, 1] - half) * step + xy[n, 0] - half
        for i in range(_BLOCK + 2):
            row = np.uint64(corner + i * step)
            for j in range(_LANES):
                at = row + np.uint64(j)
                west, middle = np.int32(images[at]), np.int32(images[at + np.uint64(1)])
                east = np.int32(images[at + np.uint64(2)])
                difference[i, j] = np.int32(east - west)
                total[i, j] = np.int32(west + np.int32(2 * middle) + east)
        sums[:] = 0
        for i in range(_BLOCK):
            for j in range(_LANES):
                along_x = np.int32(
                    difference[i, j] + np.int32(2 * difference[i + 1, j]) + difference[i + 2, j]
                )
                along_y = np.int32(total[i + 2, j] - total[i, j])
                sums[0, j] = np.int32(sums[0, j] + np.int32(along_x * along_x))
                sums[1, j] = np.int32(sums[1, j] + np.int32(along_y * along_y))
                sums[2, j] = np.int32(sums[2, j] + np.int32(along_x * along_y))
        xx, yy, both = np.int64(0), np.int64(0), np.int64(0)
        for j in range(_BLOCK):
            xx, yy, both = xx + sums[0, j], yy + sums[1, j], both + sums[2, j]
        a, b, c = np.float32(xx), np.float32(yy), np.float32(both)
        out[n] = (a * b - c * c - _HARRIS_K * (a + b) * (a + b)) * _UNIT_4
    return out


@compiled
def inside(
    found: Floats32, ends: Ints, sizes: Ints, shift: int, edge: int
) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Levels ``(N,)`` and pixels ``(N, 2)`` of corners by FAST, and which are far from the borders.

    Args:
        found: ``(N, 2)`` pixels of parts that begin ``shift`` pixels from the borders.
        ends: where each level's corners end; sizes: ``(levels, 2)`` width and height.
    """
    level = np.empty(len(found), np.int64)
    xy = np.empty((len(found), 2), np.int64)
    keep = np.empty(len(found), np.bool_)
    begin = 0
    for k in range(len(ends)):
        for n in range(begin, ends[k]):
            x, y = np.int64(found[n, 0]) + shift, np.int64(found[n, 1]) + shift
            level[n], xy[n, 0], xy[n, 1] = k, x, y
            keep[n] = edge <= x < sizes[k, 0] - edge and edge <= y < sizes[k, 1] - edge
        begin = ends[k]
    return level, xy, keep


@compiled
def spread(order: Ints, cell: Ints, count: int) -> NDArray[np.bool_]:
    """Which keypoints an even choice over cells keeps, see :func:`slamdepth.frontend.keypoints.spread`.

    Args:
        order: ``(N,)`` keypoints, the strongest first; cell: ``(N,)`` that each lies in.
    """
    filled = np.zeros(np.max(cell) + 1, np.int64)
    rank = np.empty(len(order), np.int64)
    for n in range(len(order)):
        i = order[n]
        rank[n] = filled[cell[i]]
        filled[cell[i]] += 1
    of_rank = np.zeros(np.max(filled) + 1, np.int64)
    for n in range(len(order)):
        of_rank[rank[n]] += 1
    keep = np.zeros(len(order), np.bool_)
    # all of the first ranks, and the strongest of the rank that does not fit
    last, before = 0, 0
    while before + of_rank[last] <= count and last < len(of_rank) - 1:
        before += of_rank[last]
        last += 1
    left = count - before
    for n in range(len(order)):
        if rank[n] < last:
            keep[order[n]] = True
        elif rank[n] == last and left > 0:
            keep[order[n]] = True
            left -= 1
    return keep


@inlined
def _angle(
    images: Bytes, centre: int, step: int, across: NDArray[np.int32], inside: NDArray[np.int32]
) -> Any:
    """Direction in degrees from a pixel to the centroid of the grey values in a circle around it."""
    m10, m01 = np.int32(0), np.int32(0)
    width = inside.shape[1]
    first = centre - _HALF_PATCH * step - _HALF_PATCH
    for v in range(2 * _HALF_PATCH + 1):
        row = np.uint64(first + v * step)
        total = np.int32(0)
        for u in range(width):
            value = np.int32(images[row + np.uint64(u)])
            total = np.int32(total + np.int32(inside[v, u] * value))
            m10 = np.int32(m10 + np.int32(across[v, u] * value))
        m01 = np.int32(m01 + np.int32((v - _HALF_PATCH) * total))
    x, y = np.float32(m10), np.float32(m01)
    ax, ay = abs(x), abs(y)
    c = min(ax, ay) / (max(ax, ay) + _EPSILON)
    c2 = c * c
    angle = (((_P7 * c2 + _P5) * c2 + _P3) * c2 + _P1) * c
    if ax < ay:
        angle = _90 - angle
    if x < 0:
        angle = _180 - angle
    if y < 0:
        angle = _360 - angle
    return angle


@compiled
def describe(
    images: Bytes,
    blurred: Bytes,
    starts: Ints,
    widths: Ints,
    level: Ints,
    xy: Ints,
    circle: NDArray[np.int32],
    pattern: Floats32,
) -> tuple[Floats32, Bytes]:
    """Angles ``(N,)`` in degrees and descriptors ``(N, 32)`` of keypoints.

    Args:
        circle: ``(31, 32)``, 1 at the pixels that the angle is computed from.
        pattern: ``(2, 512)`` columns and rows of the pixels that are compared, two by two.
    """
    count = pattern.shape[1]
    angles = np.empty(len(level), np.float32)
    out = np.empty((len(level), count // 16), np.uint8)
    across = np.empty_like(circle)
    for v in range(circle.shape[0]):
        for u in range(circle.shape[1]):
            across[v, u] = (u - _HALF_PATCH) * circle[v, u]
    offset = np.empty(count, np.int32)
    place = offset.view(np.uint32)  # no sign that each look-up would have to test
    for n in range(len(level)):
        step = widths[level[n]]
        centre = starts[level[n]] + xy[n, 1] * step + xy[n, 0]
        angles[n] = _angle(images, centre, step, across, circle)
        radians = np.float64(angles[n] * _TO_RADIANS)
        a, b = np.float32(math.cos(radians)), np.float32(math.sin(radians))
        # whole numbers below 2^24, exact as float32
        row, corner = np.float32(step), np.float32(_REACH * step + _REACH)
        for i in range(count):
            x, y = pattern[0, i], pattern[1, i]
            offset[i] = np.int32(np.rint(x * b + y * a) * row + np.rint(x * a - y * b) + corner)
        patch = blurred[centre - _REACH * step - _REACH : centre + _REACH * step + _REACH + 1]
        for i in range(out.shape[1]):
            byte = 0
            for bit in range(8):
                darker = patch[place[16 * i + 2 * bit]] < patch[place[16 * i + 2 * bit + 1]]
                byte |= np.int64(darker) << bit
            out[n, i] = byte
    return angles, out
