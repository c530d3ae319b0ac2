# SPDX-License-Identifier: Apache-2.0
"""A depth model that looks at every image twice: as it is, and left and right exchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.card import card_of
from slamdepth.errors import ConfigError
from slamdepth.types import DepthKind, DepthPrediction, Frame
from slamdepth.typing import Floats32


class MirroredDepth:
    """The mean of what ``model`` predicts of an image and of its mirror image, for twice the time (after
    Godard et al., "Unsupervised Monocular Depth Estimation with Left-Right Consistency", CVPR 2017).

    The mean of metres and of their uncertainty is the geometric one, as errors of depth are relative. A
    direction of gravity that the model found in the image is told for its mirror image.

    Args:
        model: any that predicts; kind and weights remain its own, and the name is ``mirrored:`` and its.

    Raises:
        ConfigError: ``model`` measures.
    """

    def __init__(self, model: DepthModel) -> None:
        if is_sensor(model):
            raise ConfigError("depth model 'mirrored:sensor': a sensor's depth needs no mirror; use 'sensor'")
        self.name, self.kind, self.weights = f"mirrored:{model.name}", model.kind, model.weights
        card = card_of(model)
        self.card = None if card is None else replace(card, name=self.name)
        self._model = model

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth ``(H, W)`` of ``frame``; metres are unknown where both looks leave them so."""
        one = self._model.predict(frame)
        other = self._model.predict(mirror_image(frame, one.gravity))
        is_metric = self.kind is DepthKind.METRIC
        values = _mean(one.values, other.values[:, ::-1], is_geometric=is_metric)
        sigma_log = one.sigma_log
        if sigma_log is not None and other.sigma_log is not None:
            sigma_log = _mean(sigma_log, other.sigma_log[:, ::-1], is_geometric=True)
        return replace(one, values=values, sigma_log=sigma_log)


def mirror_image(frame: Frame, gravity: NDArray[np.float64] | None = None) -> Frame:
    """``frame`` with left and right exchanged, without sensor depth.

    Args:
        gravity: ``(3,)`` in the camera that took ``frame``; default: what ``frame`` says.
    """
    gravity = frame.gravity if gravity is None else gravity
    return replace(
        frame,
        image_rgb=np.ascontiguousarray(frame.image_rgb[:, ::-1]),
        camera=frame.camera.mirrored(),
        depth_m=None,
        gravity=None if gravity is None else gravity * [-1.0, 1.0, 1.0],
    )


def _mean(one: Floats32, other: Floats32, *, is_geometric: bool) -> Floats32:
    """Pixel by pixel; where metres of one are 0, unknown, the other counts alone."""
    if not is_geometric:
        return ((one + other) / 2).astype(np.float32)
    return np.where((one != 0) & (other != 0), np.sqrt(one * other), one + other).astype(np.float32)
