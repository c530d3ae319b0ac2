# SPDX-License-Identifier: Apache-2.0
"""A depth model whose numbers are multiplied, and shifted, as they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.scale import DepthScale, ScaleDomain, needs_shift
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind, DepthPrediction, Frame


class ScaledDepth:
    """``model`` in metres; name and weights remain those of ``model``.

    Args:
        model: any but the sensor.
        scale: what makes metres of its numbers; a relative model needs one with a shift.

    Raises:
        ConfigError: the scale cannot make this model metric.
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
                f"depth model '{model.name}' predicts {model.kind.value}: a factor alone makes no metres of "
                "it; fit scale and shift with 'slamdepth scale SEQ --shift --output FILE'"
            )
        self.name, self.weights = model.name, model.weights
        self.scale = scale
        self._model = model

    def predict(self, frame: Frame) -> DepthPrediction:
        """Metres ``(H, W)`` and, where the model says how sure it is, that carried along."""
        prediction = self._model.predict(frame)
        depth_m = self.scale.depth_m(prediction.values)
        sigma_log = prediction.sigma_log
        if sigma_log is not None and self.scale.shift != 0.0:
            # d log(a v + b) = a v / (a v + b) d log v; the sign of a log does not matter
            scaled = self.scale.scale * prediction.values
            line = np.where(depth_m > 0, scaled + np.float32(self.scale.shift), np.float32(1.0))
            sigma_log = (sigma_log * np.abs(scaled / line)).astype(np.float32)
        return replace(prediction, values=depth_m, kind=self.kind, sigma_log=sigma_log)
