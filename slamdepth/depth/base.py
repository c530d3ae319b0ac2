# SPDX-License-Identifier: Apache-2.0
"""What a depth model is, to the rest of the house."""

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
    """

    name: str
    kind: DepthKind
    weights: tuple[WeightsInfo, ...]

    def predict(self, frame: Frame) -> DepthPrediction:
        """Predict ``(H, W)`` depth for ``frame`` at the frame's own resolution."""
        ...
