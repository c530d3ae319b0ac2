# SPDX-License-Identifier: Apache-2.0
"""OpenCV's keypoints as arrays, and an even choice of them over the image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


def pixels(keypoints: Sequence[Any]) -> Floats:
    """Positions ``(N, 2)`` of OpenCV's keypoints in pixels."""
    import cv2

    if len(keypoints) == 0:
        return np.zeros((0, 2))
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)


def responses(keypoints: Sequence[Any]) -> Floats:
    """Responses ``(N,)`` of OpenCV's keypoints."""
    return np.array([k.response for k in keypoints], dtype=np.float64)


def spread(px: Floats, response: Floats, count: int, cell_px: float) -> Ints:
    """Choose keypoints evenly over the image: each cell's best first, then each cell's second best.

    Args:
        px: ``(N, 2)`` pixels.
        response: ``(N,)`` strength.
        count: how many to keep.
        cell_px: edge of a cell in pixels.

    Returns:
        Indices, at most ``count``, in ascending order.
    """
    if len(px) <= count:
        return np.arange(len(px))
    strongest = np.argsort(-response, kind="stable")
    # sorting small integers is several times faster than sorting by two keys
    cell = cells_of_pixels(px, cell_px)[strongest]
    by_cell = np.argsort(cell, kind="stable")
    sorted_cell = cell[by_cell]
    starts = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    rank = np.empty(len(px), dtype=np.min_scalar_type(len(px)))
    rank[by_cell] = np.arange(len(px)) - np.repeat(starts, np.diff(np.r_[starts, len(px)]))
    chosen = strongest[np.argsort(rank, kind="stable")[:count]]
    return np.sort(chosen)


def cells_of_pixels(px: Floats, cell_px: float) -> NDArray[np.unsignedinteger]:
    """Numbers ``(N,)`` of the square cells of an image that ``px (N, 2)`` lie in."""
    cells = np.floor(px / cell_px).astype(np.int64)
    number = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    return np.asarray(number.astype(np.min_scalar_type(number.max())))


def cell_edge_px(gray: NDArray[np.uint8], count: int) -> float:
    """Edge of a cell for :func:`spread` that gives about two keypoints per cell."""
    return float(np.sqrt(gray.shape[0] * gray.shape[1] / count) * 1.5)
