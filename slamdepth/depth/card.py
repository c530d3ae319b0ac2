# SPDX-License-Identifier: Apache-2.0
"""What a depth model says of itself, and the check that its numbers are metres."""

from __future__ import annotations

from dataclasses import dataclass

from slamdepth.depth.base import DepthModel
from slamdepth.errors import ConfigError
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


def require_metric(model: DepthModel) -> None:
    """Refuse a model whose numbers are no metres, before they are taken for such.

    Raises:
        ConfigError: says what the model predicts instead.
    """
    if model.kind is not DepthKind.METRIC:
        raise ConfigError(
            f"depth model '{model.name}' predicts {model.kind.value}, which has no metres; "
            "choose one that predicts metric depth"
        )
