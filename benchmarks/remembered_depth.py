# SPDX-License-Identifier: Apache-2.0
"""A depth model that predicts each frame of a sequence once, for benchmarks that play it many times."""

from __future__ import annotations

import numpy as np

from benchmarks.depth_cache import DepthCache
from slamdepth.depth.base import DepthModel
from slamdepth.types import DepthPrediction, Frame


class RememberedDepth:
    """What ``model`` says of the frames of one sequence, kept in a ``cache`` of its own.

    Raises:
        OutputError: a file cannot be written.
    """

    def __init__(self, model: DepthModel, cache: DepthCache) -> None:
        self.name, self.kind, self.weights = model.name, model.kind, model.weights
        self._model = model
        self._cache = cache

    def predict(self, frame: Frame) -> DepthPrediction:
        """As the model itself, from its file where there is one."""
        if not self._cache.has(frame.index):
            predicted = self._model.predict(frame)
            maps = [predicted.values, predicted.sigma_log]
            self._cache.write(frame.index, np.stack([one for one in maps if one is not None]))
        values, *sigma = self._cache.read(frame.index)
        return DepthPrediction(values, self.kind, sigma[0] if sigma else None)
