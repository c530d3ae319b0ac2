# SPDX-License-Identifier: Apache-2.0
"""More features of a frame, for a search over a wide baseline."""

from __future__ import annotations

from slamdepth.config import FeatureConfig
from slamdepth.frontend.features import Features
from slamdepth.frontend.preparation import Preparation
from slamdepth.stopwatch import Stopwatch
from slamdepth.types import Camera, Frame

_TIMES = 3  # as many where frames are far apart
_MOST = 10000


class WideFeatures:
    """Finds three times as many features; the extractor is made when it is needed first."""

    def __init__(self, camera: Camera, config: FeatureConfig, watch: Stopwatch) -> None:
        self._camera = camera
        self._config = config
        self._watch = watch
        self._prepare: Preparation | None = None

    def __call__(self, frame: Frame) -> Features:
        """The features of ``frame``."""
        if self._prepare is None:
            count = min(_TIMES * self._config.count, _MOST)
            self._prepare = Preparation(self._camera, self._config.model_copy(update={"count": count}))
        prepared = self._prepare(frame)
        self._watch.add("features", prepared.took_ms)
        return prepared.features
