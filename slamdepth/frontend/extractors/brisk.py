# SPDX-License-Identifier: Apache-2.0
"""BRISK, of OpenCV's contrib modules since version 5."""

from __future__ import annotations

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import ScaleLevels, register_extractor
from slamdepth.frontend.metric import Hamming
from slamdepth.frontend.opencv_features import OpenCvExtractor, opencv_class


@register_extractor("brisk")
class BriskExtractor(OpenCvExtractor):
    """BRISK (Leutenegger et al. 2011), 512 bits.

    Raises:
        ConfigError: this OpenCV lacks it.
    """

    def __init__(self, config: FeatureConfig) -> None:
        super().__init__(
            opencv_class("BRISK", "brisk").create(15, 3),  # half of the usual contrast; octaves
            config.count,
            metric=Hamming(64, 120, 95),
            levels=ScaleLevels(1.25, 9),
            finest_px=11.0,
        )
