# SPDX-License-Identifier: Apache-2.0
"""A depth model that predicts each frame of a sequence once, for benchmarks that play it many times.

Stored as float16: rounding of 0.05 %, against errors of the predictions of some 20 %.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.depth.base import DepthModel
from slamdepth.io import replacing
from slamdepth.types import DepthPrediction, Frame


class RememberedDepth:
    """What ``model`` says of the frames of one sequence, in files of ``folder`` named by their index.

    Raises:
        OutputError: a file cannot be written.
    """

    def __init__(self, model: DepthModel, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.name, self.kind, self.weights = model.name, model.kind, model.weights
        self._model = model
        self._folder = folder

    def predict(self, frame: Frame) -> DepthPrediction:
        """As the model itself, from its file where there is one."""
        file = self._folder / f"{frame.index:06d}.npy"
        if file.is_file():
            values, *sigma = np.load(file).astype(np.float32)
            return DepthPrediction(values, self.kind, sigma[0] if sigma else None)
        predicted = self._model.predict(frame)
        maps = [predicted.values] if predicted.sigma_log is None else [predicted.values, predicted.sigma_log]
        stored = np.stack(maps).astype(np.float16)
        with replacing(file) as temporary, open(temporary, "wb") as out:
            np.save(out, stored)
        values, *sigma = stored.astype(np.float32)
        return DepthPrediction(values, self.kind, sigma[0] if sigma else None)
