# SPDX-License-Identifier: Apache-2.0
"""Keypoints with binary descriptors, spread over the image; extractors by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.errors import ConfigError
from slamdepth.frontend.matching import PixelGrid
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Features:
    """The keypoints of one image.

    Attributes:
        raw_px: ``(N, 2)`` float64 pixels of the image as taken.
        px: ``(N, 2)`` float64 pixels after undistortion; all geometry uses these.
        octave: ``(N,)`` int pyramid level, 0 the finest.
        sigma_px: ``(N,)`` float64 standard deviation of ``px``.
        descriptors: ``(N, 32)`` uint8 binary descriptors.
    """

    raw_px: NDArray[np.float64]
    px: NDArray[np.float64]
    octave: NDArray[np.int64]
    sigma_px: NDArray[np.float64]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.px)

    @cached_property
    def grid(self) -> PixelGrid:
        """``px`` sorted into cells; made once, since a keyframe is searched again and again."""
        return PixelGrid(self.px)


class FeatureExtractor(Protocol):
    """Finds features in a grey image."""

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        """Features of a ``(H, W)`` uint8 image taken by ``camera``."""
        ...


_EXTRACTORS: dict[str, Callable[[FeatureConfig], FeatureExtractor]] = {}


def register_extractor(
    name: str,
) -> Callable[[Callable[[FeatureConfig], FeatureExtractor]], Callable[[FeatureConfig], FeatureExtractor]]:
    """Make an extractor available as ``features.name`` in the settings."""

    def register(
        factory: Callable[[FeatureConfig], FeatureExtractor],
    ) -> Callable[[FeatureConfig], FeatureExtractor]:
        _EXTRACTORS[name] = factory
        return factory

    return register


def create_extractor(config: FeatureConfig) -> FeatureExtractor:
    """Build the extractor that ``config.name`` names.

    Raises:
        ConfigError: no extractor has that name; lists those that exist.
    """
    try:
        factory = _EXTRACTORS[config.name]
    except KeyError:
        known = ", ".join(sorted(_EXTRACTORS))
        raise ConfigError(f"features.name: no feature is called '{config.name}'; known: {known}") from None
    return factory(config)


def spread(
    px: NDArray[np.float64], response: NDArray[np.float64], count: int, cell_px: float
) -> NDArray[np.int64]:
    """Choose ``count`` keypoints evenly: every cell's best first, then every cell's second.

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
    cells = np.floor(px / cell_px).astype(np.int64)
    cell = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    order = np.lexsort((-response, cell))
    sorted_cell = cell[order]
    starts = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    rank = np.arange(len(px)) - np.repeat(starts, np.diff(np.r_[starts, len(px)]))
    rank_of = np.empty(len(px), dtype=np.int64)
    rank_of[order] = rank
    chosen = np.lexsort((-response, rank_of))[:count]
    return np.sort(chosen)


@register_extractor("orb")
class OrbExtractor:
    """ORB (Rublee et al. 2011), re-spread because OpenCV's own choice clusters."""

    candidates_per_keypoint = 4

    def __init__(self, config: FeatureConfig) -> None:
        import cv2

        self._config = config
        self._orb = cv2.ORB.create(
            nfeatures=config.count * self.candidates_per_keypoint,
            scaleFactor=config.scale_factor,
            nlevels=config.levels,
            fastThreshold=config.fast_threshold,
        )

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        config = self._config
        keypoints = self._orb.detect(gray, None)
        px = _pixels(keypoints)
        response = np.array([k.response for k in keypoints], dtype=np.float64)
        cell_px = np.sqrt(gray.shape[0] * gray.shape[1] / config.count) * 1.5
        kept = [keypoints[i] for i in spread(px, response, config.count, cell_px)]
        chosen, descriptors = self._orb.compute(gray, kept)
        n = len(chosen)
        if n == 0:
            descriptors = np.zeros((0, 32), dtype=np.uint8)
        raw_px = _pixels(chosen)
        octave = np.array([k.octave for k in chosen], dtype=np.int64)
        return Features(
            raw_px=raw_px,
            px=camera.undistort_points(raw_px),
            octave=octave,
            sigma_px=config.scale_factor ** octave.astype(np.float64),
            descriptors=np.ascontiguousarray(descriptors),
        )


def _pixels(keypoints: Sequence[Any]) -> NDArray[np.float64]:
    """Where OpenCV's keypoints are, ``(N, 2)``."""
    import cv2

    if len(keypoints) == 0:
        return np.zeros((0, 2))
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
