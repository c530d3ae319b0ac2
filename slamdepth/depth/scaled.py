# SPDX-License-Identifier: Apache-2.0
"""A depth model with a fixed scale, and shift, on its predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.scale import DepthScale, ScaleDomain, needs_shift
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind, DepthPrediction, Frame


class ScaledDepth:
    """A metric depth model made of another one; name and weights remain those of the other.

    Args:
        model: any but a sensor.
        scale: maps its values to metres; that of a relative model needs a shift.

    Raises:
        ConfigError: ``model`` is a sensor, or the scale cannot make it metric.
    """

    kind = DepthKind.METRIC

    def __init__(self, model: DepthModel, scale: DepthScale) -> None:
        if is_sensor(model):
            raise ConfigError("the sensor's depth is in metres already: a depth scale is for predicted depth")
        if scale.domain is not ScaleDomain.of(model.kind):
            raise ConfigError(
                f"a scale of {scale.domain.value} cannot be applied to '{model.name}', which predicts "
                f"{model.kind.value}"
            )
        if needs_shift(model.kind) and scale.shift == 0.0:
            raise ConfigError(
                f"depth model '{model.name}' predicts {model.kind.value}: a scale alone does not make it "
                "metric; fit scale and shift with 'slamdepth scale SEQ --shift --output FILE'"
            )
        self.name, self.weights = model.name, model.weights
        self.scale = scale
        self._model = model

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth ``(H, W)`` in metres, with the uncertainty of the model's prediction, if any, propagated."""
        prediction = self._model.predict(frame)
        depth_m = self.scale.depth_m(prediction.values)
        sigma_log = prediction.sigma_log
        if sigma_log is not None and self.scale.shift != 0.0:
            # d log(a v + b) = a v / (a v + b) d log v; the sign does not matter for a deviation.
            scaled = self.scale.scale * prediction.values
            line = np.where(depth_m > 0, scaled + np.float32(self.scale.shift), np.float32(1.0))
            sigma_log = (sigma_log * np.abs(scaled / line)).astype(np.float32)
        return replace(prediction, values=depth_m, kind=self.kind, sigma_log=sigma_log)
