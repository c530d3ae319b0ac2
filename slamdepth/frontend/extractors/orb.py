# SPDX-License-Identifier: Apache-2.0
"""ORB: the default feature, and the one that places are recognised by."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import Features, ScaleLevels, register_extractor
from slamdepth.frontend.keypoints import cell_edge_px, pixels, responses, spread
from slamdepth.frontend.metric import ORB
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray


@register_extractor("orb")
class OrbExtractor:
    """ORB (Rublee et al. 2011), re-spread because OpenCV's own choice clusters.

    Clear corners first, which is faster; faint ones where an image has too few, as ORB-SLAM does.
    """

    candidates_per_keypoint = 4
    enough_per_keypoint = 1.5

    def __init__(self, config: FeatureConfig) -> None:
        import cv2

        self._count = config.count
        self.levels = ScaleLevels(config.scale_factor, config.levels)
        thresholds = sorted({config.fast_threshold, config.fast_threshold_low}, reverse=True)
        self._orbs = [
            cv2.ORB.create(
                nfeatures=config.count * self.candidates_per_keypoint,
                scaleFactor=config.scale_factor,
                nlevels=config.levels,
                fastThreshold=threshold,
            )
            for threshold in thresholds
        ]

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        for orb in self._orbs:
            keypoints = orb.detect(gray, None)
            if len(keypoints) >= self.enough_per_keypoint * self._count:
                break
        kept = spread(pixels(keypoints), responses(keypoints), self._count, cell_edge_px(gray, self._count))
        # ORB describes fast and detects many, so only those kept are described
        chosen, descriptors = orb.compute(gray, [keypoints[i] for i in kept])
        raw_px = pixels(chosen)
        octave = np.array([k.octave for k in chosen], dtype=np.int64)
        return Features(
            raw_px=raw_px,
            px=camera.undistort_points(raw_px),
            octave=octave,
            sigma_px=self.levels.sigma_px(octave),
            descriptors=np.ascontiguousarray(descriptors) if len(chosen) else ORB.empty(),
        )
