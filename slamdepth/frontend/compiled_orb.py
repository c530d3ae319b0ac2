# SPDX-License-Identifier: Apache-2.0
"""ORB in half of the time: one pyramid for corners and descriptors, angles of the chosen keypoints only."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.compiled import Loops
from slamdepth.frontend.keypoints import cell_edge_px, cells_of_pixels, responses
from slamdepth.frontend.orb_pattern import orb_pattern
from slamdepth.typing import Floats, Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

_EDGE = 31  # pixels along the border of a level that hold no keypoint
_FAST_EDGE = _EDGE - 4  # FAST looks 3 pixels far, and at the next corner
_HALF_PATCH = 15
_BLUR = 7


@dataclass(frozen=True)
class Corners:
    """Corners of an image, level by level.

    Attributes:
        level: ``(N,)``.
        xy: ``(N, 2)`` pixels of the level.
        score: ``(N,)`` Harris scores.
    """

    level: Ints
    xy: Ints
    score: Floats32

    def taken(self, index: NDArray[Any]) -> Corners:
        """Only the corners ``index``."""
        return Corners(self.level[index], self.xy[index], self.score[index])


@dataclass(frozen=True)
class _FastCorners:
    """Corners by FAST, by level, row and column.

    Attributes:
        level: ``(N,)``; xy: ``(N, 2)`` pixels of the level.
        strength: gives the thresholds ``(N,)`` up to which they are corners; asking takes a while.
    """

    level: Ints
    xy: Ints
    strength: Callable[[], Floats32]

    def at_least(self, threshold: int) -> _FastCorners:
        """What FAST finds with a higher threshold."""
        strength = self.strength()
        clear = strength >= threshold
        kept = strength[clear]
        return _FastCorners(self.level[clear], self.xy[clear], lambda: kept)


class _OrderUnknownError(Exception):
    """OpenCV would order keypoints in another way."""


class CompiledOrb:
    """Evenly spread keypoints and descriptors as ``cv2.ORB`` gives them, the same to the last bit.

    Args:
        loops: that are compiled.
        candidates: corners that are kept of an image, at most, shared out among the levels.
    """

    def __init__(self, loops: Loops, config: FeatureConfig, candidates: int) -> None:
        self._loops, self._retain = loops.orb, loops.retain
        self._count = config.count
        factor = float(np.float32(config.scale_factor))
        self._scale = np.array([factor**level for level in range(config.levels)], dtype=np.float32)
        self._most = _shares(candidates, factor, config.levels)
        self._circle = _circle()
        self._pattern = np.ascontiguousarray(orb_pattern().T)
        self._fast: dict[int, Any] = {}
        self._shape = (0, 0)
        self._is_faint = False  # the last image had few clear corners

    def extract(self, gray: Bytes, thresholds: list[int], enough: float) -> tuple[Floats, Ints, Bytes] | None:
        """Pixels ``(N, 2)``, levels ``(N,)`` and descriptors ``(N, 32)`` of evenly spread corners.

        Args:
            thresholds: of FAST, the second and lower one where fewer than ``enough`` corners are found.

        Returns:
            None where the order that OpenCV would give is not known.
        """
        self._build(gray)
        try:
            corners = self._detect(thresholds[0], thresholds[-1], enough)
        except _OrderUnknownError:
            return None
        px = self._pixels(corners).astype(np.float64)
        if len(px) > self._count:
            cell = cells_of_pixels(px, cell_edge_px(gray, self._count))
            keep = self._loops.spread(_strongest_first(corners.score), cell, self._count)
            corners, px = corners.taken(keep), px[keep]
        _, descriptors = self._loops.describe(
            self._grey,
            self._blur(),
            self._starts,
            self._widths,
            corners.level,
            corners.xy,
            self._circle,
            self._pattern,
        )
        return px, corners.level, descriptors

    def _pixels(self, corners: Corners) -> Floats32:
        """Pixels ``(N, 2)`` of the whole image."""
        return corners.xy.astype(np.float32) * self._scale[corners.level][:, None]

    def _allocate(self, shape: tuple[int, int]) -> None:
        """Room for the pyramid of images of one shape."""
        sizes = [
            (int(np.rint(np.float32(shape[0]) * one)), int(np.rint(np.float32(shape[1]) * one)))
            for one in np.float32(1.0) / self._scale
        ]
        areas = [height * width for height, width in sizes]
        self._shape = shape
        self._starts = np.concatenate([[0], np.cumsum(areas)[:-1]])
        self._widths = np.array([width for _, width in sizes])
        self._sizes = np.array(sizes)[:, ::-1].copy()
        self._grey, self._blurred = (np.empty(sum(areas), dtype=np.uint8) for _ in range(2))
        self._levels, self._blurred_levels = (
            [
                whole[start : start + area].reshape(size)
                for start, area, size in zip(self._starts, areas, sizes, strict=True)
            ]
            for whole in (self._grey, self._blurred)
        )

    def _build(self, gray: Bytes) -> None:
        import cv2

        if gray.shape != self._shape:
            self._allocate((gray.shape[0], gray.shape[1]))
        self._levels[0][:] = gray
        for larger, level in zip(self._levels, self._levels[1:], strict=False):
            cv2.resize(larger, level.shape[::-1], dst=level, interpolation=cv2.INTER_LINEAR_EXACT)

    def _blur(self) -> Bytes:
        import cv2

        kernel = cv2.getGaussianKernel(_BLUR, 2, cv2.CV_32F)
        for level, blurred in zip(self._levels, self._blurred_levels, strict=True):
            # what cv2.GaussianBlur does where it is given a part of an image, as ORB gives it
            cv2.sepFilter2D(level, cv2.CV_8U, kernel, kernel, dst=blurred, borderType=cv2.BORDER_REFLECT_101)
        return self._blurred

    def _detect(self, clear: int, faint: int, enough: float) -> Corners:
        """The best corners of each level by their Harris scores; faint ones where the clear ones are few.

        Where the last image had few, the faint ones are sought first, as the clear ones are among them.
        """
        if not self._is_faint:
            found = self._fast_corners(clear)
            best = self._best_corners(found)
            if len(best.level) >= enough or clear == faint:
                return best
            found = self._fast_corners(faint)
        else:
            found = self._fast_corners(faint)
            best = self._best_corners(found.at_least(clear))
            if len(best.level) >= enough:
                self._is_faint = False
                return best
        self._is_faint = True
        return self._best_corners(found)

    def _best_corners(self, found: _FastCorners) -> Corners:
        """Each level's best corners by FAST, twice its share, and of these the best by Harris scores."""
        level, xy = found.level, found.xy
        if (np.bincount(level, minlength=len(self._most)) > 2 * self._most).any():
            best = self._best(level, found.strength(), 2 * self._most)
            level, xy = level[best], xy[best]
        score = self._loops.harris(self._grey, self._starts, self._widths, level, xy)
        return Corners(level, xy, score).taken(self._best(level, score, self._most))

    def _best(self, level: Ints, score: Floats32, most: Ints) -> Ints:
        """The ``most`` best of each level in OpenCV's order, and ties with the last; levels ascend."""
        ends = np.searchsorted(level, np.arange(len(most)), side="right")
        is_known, kept = self._retain.best_of_levels(score, ends, most)
        if not is_known:
            raise _OrderUnknownError
        return np.asarray(kept)

    def _fast_corners(self, threshold: int) -> _FastCorners:
        import cv2

        if threshold not in self._fast:
            self._fast[threshold] = cv2.FastFeatureDetector.create(threshold, True)
        found = [
            self._fast[threshold].detect(image[_FAST_EDGE:-_FAST_EDGE, _FAST_EDGE:-_FAST_EDGE], None)
            if min(image.shape) > 2 * _EDGE
            else ()
            for image in self._levels
        ]
        ends = np.cumsum([len(keypoints) for keypoints in found])
        px = [np.asarray(cv2.KeyPoint.convert(keypoints)) for keypoints in found if keypoints]
        px = [np.zeros((0, 2), dtype=np.float32), *px]
        level, xy, keep = self._loops.inside(np.concatenate(px), ends, self._sizes, _FAST_EDGE, _EDGE)

        def strength() -> Floats32:
            of_levels = [responses(keypoints).astype(np.float32) for keypoints in found]
            return np.asarray(np.concatenate(of_levels)[keep])

        return _FastCorners(level[keep], xy[keep], strength)


def _strongest_first(score: Floats32) -> Ints:
    """Indices ``(N,)`` by falling score, of equal ones the first first."""
    # sorting packed integers is several times faster than a stable sort of numbers
    bits = (score + np.float32(0.0)).view(np.int32)  # without a negative zero
    rising = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    return np.sort((~rising).astype(np.int64) << 32 | np.arange(len(score))) & 0xFFFFFFFF


def _shares(count: int, factor: float, levels: int) -> Ints:
    """How many of ``count`` keypoints each level may have, in proportion to its size."""
    ratio = np.float32(1.0 / factor)
    share = np.float32(count) * (1 - ratio) / (1 - np.float32(float(ratio) ** levels))
    shares = []
    for _ in range(levels - 1):
        shares.append(round(float(share)))
        share *= ratio
    return np.array([*shares, max(count - sum(shares), 0)])


def _circle() -> NDArray[np.int32]:
    """A circle of 31 pixels, alike along both axes: ``(31, 32)``, 1 inside."""
    middle = math.ceil(_HALF_PATCH * math.sqrt(2.0) / 2.0)
    half = [round(math.sqrt(_HALF_PATCH**2 - v * v)) for v in range(middle + 1)] + [0] * (
        _HALF_PATCH - middle
    )
    row = 0
    for v in range(_HALF_PATCH, middle - 1, -1):
        while half[row] == half[row + 1]:
            row += 1
        half[v] = row
        row += 1
    circle = np.zeros((2 * _HALF_PATCH + 1, 2 * _HALF_PATCH + 2), dtype=np.int32)
    for v in range(-_HALF_PATCH, _HALF_PATCH + 1):
        circle[v + _HALF_PATCH, _HALF_PATCH - half[abs(v)] : _HALF_PATCH + half[abs(v)] + 1] = 1
    return circle
