# SPDX-License-Identifier: Apache-2.0
"""The interface of a depth model."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo


@runtime_checkable
class DepthModel(Protocol):
    """Turns a frame into a depth map.

    Attributes:
        name: the registered name.
        kind: what the numbers of its predictions mean.
        weights: every weights file the model uses; empty where it uses none.

    A model may also have ``is_sensor = True``, see :func:`is_sensor`.
    """

    name: str
    kind: DepthKind
    weights: tuple[WeightsInfo, ...]

    def predict(self, frame: Frame) -> DepthPrediction:
        """Predict ``(H, W)`` depth for ``frame`` at the frame's own resolution."""
        ...


def is_sensor(model: DepthModel) -> bool:
    """Whether ``model`` passes measured depth on; it says so by an attribute ``is_sensor``, absent means no.

    A sensor costs no time, may have no depth for a frame, and its scale is exact.
    """
    return bool(getattr(model, "is_sensor", False))
