# SPDX-License-Identifier: Apache-2.0
"""AKAZE, of OpenCV's contrib modules since version 5."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import ScaleLevels, register_extractor
from slamdepth.frontend.metric import Hamming, whole_words
from slamdepth.frontend.opencv_features import OpenCvExtractor, opencv_class

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SUBLEVELS = 4  # of an octave


@register_extractor("akaze")
class AkazeExtractor(OpenCvExtractor):
    """AKAZE (Alcantarilla et al. 2013) with M-LDB: 486 bits, filled up to 64 bytes.

    Raises:
        ConfigError: this OpenCV lacks it.
    """

    def __init__(self, config: FeatureConfig) -> None:
        super().__init__(
            # a tenth of the usual threshold: weak texture is spread over, too
            opencv_class("AKAZE", "akaze").create(threshold=1e-4, nOctaveLayers=_SUBLEVELS),
            config.count,
            metric=Hamming(64, 100, 85),
            levels=ScaleLevels(2.0 ** (1 / _SUBLEVELS), 16),
            finest_px=4.8,
        )

    def descriptors(self, described: NDArray[Any]) -> NDArray[np.uint8]:
        return whole_words(described)
