# SPDX-License-Identifier: Apache-2.0
"""Sensor depth as a depth model: the measured depth of each frame, passed through."""

from __future__ import annotations

import numpy as np

from slamdepth.depth.registry import register
from slamdepth.errors import DatasetError
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

KINECT_NOISE_PER_M = 0.0014
"""Relative noise of a Kinect per metre of depth: about 1.4 mm * z^2 (Khoshelham and Elberink 2012)."""
SIGMA_FLOOR = 0.002
"""Relative noise at any depth, of quantisation, registration and the lens."""


@register("sensor")
class SensorDepth:
    """Passes ``frame.depth_m`` through, with the noise of a Kinect as its uncertainty."""

    name = "sensor"
    kind = DepthKind.METRIC
    is_sensor = True
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, *, device: str = "cpu", seed: int = 0) -> None:
        del device, seed

    def predict(self, frame: Frame) -> DepthPrediction:
        """The measured depth of ``frame``, 0 (unknown) where it is not finite or negative.

        Raises:
            DatasetError: the frame has no depth.
        """
        if frame.depth_m is None:
            raise DatasetError(
                f"frame {frame.index} has no sensor depth; choose a predicted depth (--depth dinov2)"
            )
        values = frame.depth_m.astype(np.float32, copy=False)  # shared with the frame, not copied
        unknown = ~(np.isfinite(values) & (values >= 0))
        if unknown.any():
            values = np.where(unknown, np.float32(0.0), values)
        sigma_log = np.hypot(KINECT_NOISE_PER_M * values, SIGMA_FLOOR).astype(np.float32)
        return DepthPrediction(values, self.kind, sigma_log, is_sensor=True)
