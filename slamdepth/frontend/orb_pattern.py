# SPDX-License-Identifier: Apache-2.0
"""The pixels that OpenCV's ORB compares, read off the OpenCV that is installed."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np

from slamdepth.typing import Bools, Floats32, Ints

_REACH = 15  # no compared pixel is farther from the keypoint, along either axis
_TILE = 2 * 32  # pixels between two keypoints: neither pattern nor blur reaches the next tile
_DIRECTIONS = ((1, 0), (0, 1), (1, 1))


@lru_cache(maxsize=1)
def orb_pattern() -> Floats32:
    """Offsets ``(512, 2)`` of the pixels that bits 0 to 255 of a descriptor compare, two for each bit.

    Keypoints in front of brightness edges are described. A bit tells that the first pixel is darker than the
    second, so the edges at which it is set lie between the two.
    """
    across, along_y, sums = (_projections(direction) for direction in _DIRECTIONS)
    # where two pixels share a column their rows differ, and so do the sums of column and row
    x = np.where(across[:, :1] == across[:, 1:], sums - along_y, across)
    y = np.where(along_y[:, :1] == along_y[:, 1:], sums - x, along_y)
    return np.stack([x, y], axis=2).reshape(-1, 2).astype(np.float32)


def _projections(direction: tuple[int, int]) -> Ints:
    """Projections ``(256, 2)`` of both pixels of each bit on a direction; two zeros where they are equal."""
    import cv2

    reach = _REACH * sum(direction)
    side = np.arange(-_TILE // 2, _TILE // 2)
    place = direction[0] * side[None, :] + direction[1] * side[:, None]
    edges = np.arange(-reach - 4, reach + 5)
    tiles = [255 * (sign * (place - edge) > 0) for sign, edge in product((1, -1), edges)]
    image = np.pad(np.hstack(tiles), _TILE).astype(np.uint8)
    row, columns = 3 * _TILE // 2, 3 * _TILE // 2 + _TILE * np.arange(len(tiles))
    keypoints = [cv2.KeyPoint(float(column), float(row), 31.0, 0.0, 0.0, 0) for column in columns]
    described = np.asarray(cv2.ORB.create().compute(image, keypoints)[1], dtype=np.uint8)
    is_set = np.unpackbits(described, axis=1, bitorder="little").astype(bool)
    grey = np.empty_like(image)
    cv2.GaussianBlur(image, (7, 7), 2, dst=grey, sigmaY=2, borderType=cv2.BORDER_REFLECT_101)
    # one pixel for each projection
    steps = np.arange(-reach, reach + 1)
    along_x = steps - steps // 2 if all(direction) else steps * direction[0]
    seen = grey[row + (steps - along_x) * direction[1], columns[:, None] + along_x]
    places = np.stack([_pair(seen, bit) for bit in is_set.T])
    return np.asarray(places - reach * np.asarray(is_set.any(axis=0))[:, None])


def _pair(seen: Ints, is_set: Bools) -> Ints:
    """Two places whose grey values ``seen (edges, places)`` explain a bit at each edge; else zeros."""
    if not is_set.any():
        return np.zeros(2, dtype=np.int64)
    darker = seen[:, :, None] < seen[:, None, :]
    wrong = (darker != is_set[:, None, None]).sum(axis=0)
    return np.array(np.unravel_index(wrong.argmin(), wrong.shape))
