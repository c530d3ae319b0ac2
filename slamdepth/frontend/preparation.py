# SPDX-License-Identifier: Apache-2.0
"""Features of a frame, which any thread may find before the frame's turn comes."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import Features, create_extractor
from slamdepth.thread_limits import single_threaded
from slamdepth.types import Camera, Frame


@dataclass(frozen=True)
class Prepared:
    """A frame's features, and how many milliseconds they took."""

    features: Features
    took_ms: float


class Preparation:
    """Finds features; any thread may call it, one at a time is served.

    Attributes:
        levels: sizes the features come in.

    Raises:
        ConfigError, WeightsError: as ``create_extractor``.
    """

    def __init__(self, camera: Camera, config: FeatureConfig) -> None:
        self._camera = camera
        self._extractor = create_extractor(config)
        self._in_use = threading.Lock()
        self.levels = self._extractor.levels

    def __call__(self, frame: Frame) -> Prepared:
        import cv2

        with self._in_use, single_threaded():
            start = time.perf_counter()
            gray = np.asarray(cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            features = self._extractor.extract(gray, self._camera)
            return Prepared(features, (time.perf_counter() - start) * 1e3)
