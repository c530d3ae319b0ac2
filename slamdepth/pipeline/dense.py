# SPDX-License-Identifier: Apache-2.0
"""Dense depth of a finished map's keyframes, from the frames of its sequence."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.dense import EFFORTS, Effort, SourceFrame, densify
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.types import StepResult
from slamdepth.typing import Bytes

logger = logging.getLogger(__name__)


def measure_surfaces(
    dataset: Dataset,
    reconstruction: Reconstruction,
    steps: Sequence[StepResult],
    config: Config,
    tell: ProgressCallback,
) -> Reconstruction:
    """The same map, its keyframes with surfaces measured from many views as ``config.dense`` asks.

    Args:
        steps: of the tracker; they tell which frame has which time.
    """
    effort = _effort(reconstruction, config)
    if effort is None:
        return reconstruction
    index = {step.timestamp_s: step.index for step in steps}
    trajectory = reconstruction.trajectory
    frames = [
        SourceFrame(index[time_s], time_s, pose)
        for time_s, pose in zip(trajectory.timestamps_s.tolist(), trajectory.T_world_camera, strict=True)
        if time_s in index
    ]

    def read(number: int) -> Bytes:
        return dataset.read(number).image_rgb

    tell(RunProgress(RunStage.DENSE))
    return densify(
        reconstruction,
        frames,
        read,
        effort,
        lambda done, total: tell(RunProgress(RunStage.DENSE, done, total)),
    )


def _effort(reconstruction: Reconstruction, config: Config) -> Effort | None:
    mode = config.dense.mode
    if mode == "auto":
        mode = "off" if any(kf.prediction.is_sensor for kf in reconstruction.keyframes) else "fast"
    return EFFORTS.get(mode)
