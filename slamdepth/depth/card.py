# SPDX-License-Identifier: Apache-2.0
"""Facts about a depth model: what it predicts, and what it was trained on."""

from __future__ import annotations

from dataclasses import dataclass

from slamdepth.depth.base import DepthModel
from slamdepth.types import DepthKind


@dataclass(frozen=True)
class ModelCard:
    """The facts of a depth model that decide how its predictions may be used.

    Attributes:
        name: the registered name.
        kind: what its values mean.
        native_size: rows and columns, in pixels, of the network's input in training.
        native_focal_px: focal length of those inputs in pixels, or None where there is no single one (several
            cameras, or values that are not metric).
        licence: of the weights.
        trained_on: the data.
    """

    name: str
    kind: DepthKind
    native_size: tuple[int, int]
    native_focal_px: float | None
    licence: str
    trained_on: str


def card_of(model: DepthModel) -> ModelCard | None:
    """The card of a model; None where it has none, such as a sensor or a plug-in."""
    card = getattr(model, "card", None)
    return card if isinstance(card, ModelCard) else None
