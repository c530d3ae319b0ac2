# SPDX-License-Identifier: Apache-2.0
"""The interface of a depth model."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo


@runtime_checkable
class DepthModel(Protocol):
    """Turns a frame into a depth map.

    A model that passes measured depth on also has an attribute ``is_sensor = True``, see :func:`is_sensor`.

    Attributes:
        name: the registered name.
        kind: what the values of its predictions mean.
        weights: every weights file the model uses; empty where it uses none.
    """

    name: str
    kind: DepthKind
    weights: tuple[WeightsInfo, ...]

    def predict(self, frame: Frame) -> DepthPrediction:
        """Predict depth for every raw (not undistorted) pixel of ``frame``, ``(H, W)``."""
        ...


def is_sensor(model: DepthModel) -> bool:
    """Whether ``model`` passes measured depth on, by its attribute ``is_sensor``; without one it does not.

    A sensor costs no time, may have no depth for a frame, and its scale is exact.
    """
    return bool(getattr(model, "is_sensor", False))
