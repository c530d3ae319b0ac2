# SPDX-License-Identifier: Apache-2.0
"""Dense depth of a finished map's keyframes, as the settings ask."""

from __future__ import annotations

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.dense import densify
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage


def measure_depth(
    dataset: Dataset, reconstruction: Reconstruction, config: Config, tell: ProgressCallback
) -> Reconstruction:
    """The same map; its keyframes have depth measured from many views, unless ``config.dense`` is off."""
    mode = config.dense.mode
    if mode == "auto":
        mode = "off" if any(kf.prediction.is_sensor for kf in reconstruction.keyframes) else "fast"
    if mode == "off":
        return reconstruction
    tell(RunProgress(RunStage.DENSE))
    return densify(
        reconstruction, dataset, mode, lambda done, total: tell(RunProgress(RunStage.DENSE, done, total))
    )
