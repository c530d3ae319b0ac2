# SPDX-License-Identifier: Apache-2.0
"""What a depth model says of itself."""

from __future__ import annotations

from dataclasses import dataclass

from slamdepth.depth.base import DepthModel
from slamdepth.types import DepthKind


@dataclass(frozen=True)
class ModelCard:
    """The facts of a depth model that decide how its predictions may be used.

    Attributes:
        name: the registered name.
        kind: what its numbers mean.
        native_size: rows and columns, in pixels, of the images it was trained on, as the
            network saw them.
        native_focal_px: focal length of those images in pixels at that size, or None
            where it has none (several cameras, or values without metres).
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
    """The card of a model; None for one without: a sensor learnt nothing, a plug-in need not have one."""
    card = getattr(model, "card", None)
    return card if isinstance(card, ModelCard) else None
