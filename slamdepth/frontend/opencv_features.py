# SPDX-License-Identifier: Apache-2.0
"""Extractors made of OpenCV's ``Feature2D``: many keypoints are detected, an even share is kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import ConfigError
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.keypoints import cell_edge_px, pixels, responses, spread
from slamdepth.frontend.metric import DescriptorMetric
from slamdepth.frontend.orb_descriptors import OrbDescriptors
from slamdepth.types import Camera
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


class OpenCvExtractor:
    """An OpenCV ``Feature2D`` as an extractor.

    Args:
        algorithm: set so that it finds more than ``count`` in most images.
        count: keypoints kept per image.
        metric: of the descriptors that :meth:`descriptors` returns.
        levels: scale levels; larger keypoints than those of the last are dropped.
        finest_px: ``cv2.KeyPoint.size`` of level 0.
    """

    def __init__(
        self,
        algorithm: Any,
        count: int,
        *,
        metric: DescriptorMetric,
        levels: ScaleLevels,
        finest_px: float,
    ) -> None:
        self._algorithm = algorithm
        self._count = count
        self._metric = metric
        self.levels = levels
        self._finest_px = finest_px

    def extract(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        """See :class:`slamdepth.frontend.features.FeatureExtractor`."""
        keypoints, described = self._algorithm.detectAndCompute(gray, None)
        raw_px = pixels(keypoints)
        octave = self.levels.of(np.array([k.size for k in keypoints], dtype=np.float64) / self._finest_px)
        usable = np.flatnonzero(octave < self.levels.count)
        usable = usable[_first_of_each(raw_px[usable])]
        response = responses(keypoints)[usable]
        kept = usable[spread(raw_px[usable], response, self._count, cell_edge_px(gray, self._count))]
        raw_px, octave = raw_px[kept], octave[kept]
        return Features(
            raw_px=raw_px,
            px=camera.undistort_points(raw_px),
            octave=octave,
            sigma_px=self.levels.sigma_px(octave),
            descriptors=self.descriptors(described[kept]) if len(kept) else self._metric.empty(),
            metric=self._metric,
            orb_descriptors=OrbDescriptors(gray, self._count),
        )

    def descriptors(self, described: NDArray[Any]) -> NDArray[Any]:
        """OpenCV's descriptors ``(N, D)`` in the form that the metric compares."""
        return np.ascontiguousarray(described)


def opencv_class(name: str, feature: str) -> Any:
    """OpenCV's class ``name``, from whichever module this version has it in.

    Raises:
        ConfigError: this build lacks it; says which package brings it.
    """
    import cv2

    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        found = getattr(module, name, None)
        if found is not None:
            return found
    raise ConfigError(
        f"feature '{feature}' is not in this OpenCV ({cv2.__version__}): install "
        "opencv-contrib-python-headless in place of opencv-python-headless"
    )


def _first_of_each(px: Floats) -> NDArray[np.int64]:
    """Indices of the first keypoint at each pixel.

    SIFT describes one pixel once for each orientation it may have; two features at one pixel would
    become two landmarks.
    """
    _, first = np.unique(px, axis=0, return_index=True)
    return np.sort(first)
