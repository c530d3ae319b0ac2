# SPDX-License-Identifier: Apache-2.0
"""Facts about a depth model: what it predicts, and what it was trained on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slamdepth.depth.base import DepthModel
from slamdepth.errors import WeightsError
from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from typing_extensions import Self


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
        range_m: nearest and farthest depth in metres that it can predict at its native focal length; None
            where it is not bounded or not metric.
    """

    name: str
    kind: DepthKind
    native_size: tuple[int, int]
    native_focal_px: float | None
    licence: str
    trained_on: str
    range_m: tuple[float, float] | None = None


Side = Annotated[int, Field(ge=1, le=1 << 14)]


class StatedFacts(BaseModel):
    """What the author of a weights file says of it, as JSON next to the file or in it.

    Attributes:
        kind: what the values mean.
        input_size: rows and columns that the network was trained with.
        focal_px: focal length in pixels of the training images at that size; metric depth only.
        licence: of the weights.
        trained_on: the data.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: DepthKind
    input_size: tuple[Side, Side] | None = None
    focal_px: float | None = Field(None, gt=0)
    licence: str = "unknown"
    trained_on: str = "unknown"

    @classmethod
    def parse(cls, text: str, origin: str) -> Self:
        """The facts in JSON ``text``; ``origin`` is named in errors.

        Raises:
            WeightsError: it is no JSON, or a fact is missing, unknown or out of range.
        """
        try:
            return cls.model_validate(json.loads(text))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "the whole"
            raise WeightsError(f"{origin}: {where}: {first['msg']}") from error
        except ValueError as error:
            raise WeightsError(f"{origin}: not readable as JSON: {error}") from error

    @classmethod
    def read(cls, path: Path) -> Self:
        """The facts in a JSON file.

        Raises:
            WeightsError: as for :meth:`parse`, or the file cannot be read.
        """
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise WeightsError(f"{path}: cannot be read: {error}") from error
        return cls.parse(text, str(path))


def card_of(model: DepthModel) -> ModelCard | None:
    """The card of a model; None where it has none, such as a sensor or a plug-in."""
    card = getattr(model, "card", None)
    return card if isinstance(card, ModelCard) else None
