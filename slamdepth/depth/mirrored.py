# SPDX-License-Identifier: Apache-2.0
"""A depth model that predicts every image twice: as taken, and flipped left to right."""

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
    """The mean of a model's predictions for an image and for its mirror image, at twice the time.

    After Godard et al., "Unsupervised Monocular Depth Estimation with Left-Right Consistency", CVPR 2017.
    Metric depth and uncertainty are averaged geometrically, because errors of depth are relative. The
    direction of gravity that the model estimates in the image is used for the mirror image too.

    Args:
        model: any that predicts. Kind and weights remain its own; the name is its own after ``mirrored:``.

    Raises:
        ConfigError: ``model`` is a sensor.
    """

    def __init__(self, model: DepthModel) -> None:
        if is_sensor(model):
            raise ConfigError(
                f"depth model 'mirrored:{model.name}': a sensor's depth needs no mirror; use '{model.name}'"
            )
        self.name, self.kind, self.weights = f"mirrored:{model.name}", model.kind, model.weights
        card = card_of(model)
        self.card = None if card is None else replace(card, name=self.name)
        self._model = model

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth ``(H, W)`` of ``frame``; metric depth is unknown where both predictions leave it unknown."""
        one = self._model.predict(frame)
        other = self._model.predict(mirror_image(frame, one.gravity))
        is_metric = self.kind is DepthKind.METRIC
        values = _mean(one.values, other.values[:, ::-1], is_geometric=is_metric)
        sigma_log = one.sigma_log
        if sigma_log is not None and other.sigma_log is not None:
            sigma_log = _mean(sigma_log, other.sigma_log[:, ::-1], is_geometric=True)
        return replace(one, values=values, sigma_log=sigma_log)


def mirror_image(frame: Frame, gravity: NDArray[np.float64] | None = None) -> Frame:
    """``frame`` flipped left to right, with its camera and gravity, without sensor depth.

    Args:
        frame: as taken.
        gravity: ``(3,)`` in the camera's frame (x right, y down, z forward); default: that of ``frame``.
    """
    gravity = frame.gravity if gravity is None else gravity
    return replace(
        frame,
        image_rgb=np.ascontiguousarray(frame.image_rgb[:, ::-1]),
        camera=frame.camera.mirrored(),
        depth_m=None,
        gravity=None if gravity is None else gravity * [-1.0, 1.0, 1.0],
        gravity_is_guess=False,
    )


def _mean(one: Floats32, other: Floats32, *, is_geometric: bool) -> Floats32:
    """Mean of two maps; of the geometric mean, where one is 0 (unknown) the other is taken alone."""
    if not is_geometric:
        return ((one + other) / 2).astype(np.float32)
    return np.where((one != 0) & (other != 0), np.sqrt(one * other), one + other).astype(np.float32)
