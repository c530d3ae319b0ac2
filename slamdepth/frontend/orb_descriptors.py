# SPDX-License-Identifier: Apache-2.0
"""ORB descriptors of an image for place recognition, where its features are others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.extractors.orb import OrbExtractor
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray


class OrbDescriptors:
    """ORB descriptors of an image, computed on the first call, after which the image is released.

    Only keyframes and lost frames need them, so other features cost no ORB on every frame.

    Args:
        gray: ``(H, W)`` uint8.
        count: largest number of descriptors.
    """

    def __init__(self, gray: NDArray[np.uint8], count: int) -> None:
        self._gray: NDArray[np.uint8] | None = gray
        self._count = count
        self._found: NDArray[np.uint8] | None = None

    def __call__(self) -> NDArray[np.uint8]:
        """Descriptors ``(M, 32)`` uint8."""
        if self._found is None:
            assert self._gray is not None
            height, width = self._gray.shape
            ideal = Camera(width, height, width, width, 0.5 * (width - 1), 0.5 * (height - 1))
            extractor = OrbExtractor(FeatureConfig(count=self._count))
            self._found = extractor.extract(self._gray, ideal).descriptors
            self._gray = None
        return self._found
