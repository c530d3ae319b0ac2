# SPDX-License-Identifier: Apache-2.0
"""Sensor depth as a depth model: what a depth camera measured, passed through."""

from __future__ import annotations

import numpy as np

from slamdepth.depth.registry import register
from slamdepth.errors import DatasetError
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

KINECT_NOISE_PER_M = 0.0014
"""Noise of a Kinect is about 1.4 mm x z^2, so 0.0014 x z of z (Khoshelham and Elberink 2012)."""
SIGMA_FLOOR = 0.002
"""Of quantisation, registration and the lens, whatever the distance."""


@register("sensor")
class SensorDepth:
    """Passes ``frame.depth_m`` through, with a Kinect's noise as its uncertainty."""

    name = "sensor"
    kind = DepthKind.METRIC
    is_sensor = True
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, *, device: str = "cpu", seed: int = 0) -> None:
        del device, seed

    def predict(self, frame: Frame) -> DepthPrediction:
        """The measured depth of ``frame``, non-finite and negative values made unknown.

        Raises:
            DatasetError: the frame has no depth.
        """
        if frame.depth_m is None:
            raise DatasetError(
                f"frame {frame.index} has no sensor depth; choose a predicted depth (--depth dinov2)"
            )
        values = frame.depth_m.astype(np.float32, copy=False)  # shared, not kept twice
        unknown = ~(np.isfinite(values) & (values >= 0))
        if unknown.any():
            values = np.where(unknown, np.float32(0.0), values)
        sigma_log = np.hypot(KINECT_NOISE_PER_M * values, SIGMA_FLOOR).astype(np.float32)
        return DepthPrediction(values, self.kind, sigma_log, is_sensor=True)
