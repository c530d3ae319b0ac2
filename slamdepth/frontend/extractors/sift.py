# SPDX-License-Identifier: Apache-2.0
"""SIFT, described as RootSIFT."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import ScaleLevels, register_extractor
from slamdepth.frontend.metric import UnitL2
from slamdepth.frontend.opencv_features import OpenCvExtractor
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LAYERS = 3  # of an octave, as Lowe has it


@register_extractor("sift")
class SiftExtractor(OpenCvExtractor):
    """SIFT (Lowe 2004) as RootSIFT (Arandjelović and Zisserman, "Three things everyone should know to
    improve object retrieval", 2012): the square roots of its normalised histogram, of unit length."""

    def __init__(self, config: FeatureConfig) -> None:
        import cv2

        super().__init__(
            cv2.SIFT.create(
                nOctaveLayers=_LAYERS,
                contrastThreshold=0.02,  # half of Lowe's: weak texture is spread over, too
                enable_precise_upscale=True,  # without, all places are a quarter of a pixel off
            ),
            config.count,
            metric=UnitL2(128, max_l2=0.5, strict_l2=0.4),
            levels=ScaleLevels(2.0 ** (1 / _LAYERS), 14, growth=0.5),
            finest_px=1.8,
        )

    def descriptors(self, described: NDArray[Any]) -> Floats32:
        total = np.maximum(described.sum(axis=1, keepdims=True), 1e-6)
        roots: Floats32 = np.sqrt(described / total, dtype=np.float32)
        return roots
