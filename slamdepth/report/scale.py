# SPDX-License-Identifier: Apache-2.0
"""The scale of a map, and where it comes from."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any


class ScaleSource(str, Enum):
    """Where the scale of a map comes from."""

    SENSOR = "sensor"
    NETWORK = "network"
    FILE = "file"
    VALUE = "value"
    GROUND_TRUTH_DEPTH = "groundtruth-depth"
    GROUND_TRUTH_TRAJECTORY = "groundtruth-trajectory"
    CAMERA_HEIGHT = "camera-height"
    BASELINE = "baseline"


@dataclass(frozen=True)
class ScalePart:
    """One of several estimates that were combined.

    Attributes:
        source: where it comes from.
        factor: on the depth model's own lengths.
        uncertainty_log: standard deviation of the natural log of ``factor``.
        weight: its share in the combination, 0 to 1.
    """

    source: ScaleSource
    factor: float
    uncertainty_log: float
    weight: float


@dataclass(frozen=True)
class ScaleFacts:
    """The scale of a run.

    Attributes:
        source: where it comes from; of several estimates, the one with the largest weight.
        factor: total factor on the depth model's own lengths; of a relative model, on its numbers.
        sentence: all of this for people.
        uncertainty_log: standard deviation of the natural log of ``factor``, measured or assumed
            (``sentence`` says which); None where it is unknown.
        keyframes: number of keyframes that voted on the map's scale.
        spread: standard deviation of their votes (log ratios of map to predicted depth).
        prediction_factor: the part of ``factor`` that was applied to predictions; the rest was applied to
            the finished map.
        shift, shift_unit: added to the model's numbers after ``prediction_factor``, else None.
        from_ground_truth: True where the scale was taken from what the run is scored by.
        parts: the estimates that were combined, where there were several.
    """

    source: ScaleSource
    factor: float
    sentence: str
    uncertainty_log: float | None = None
    keyframes: int = 0
    spread: float | None = None
    prediction_factor: float = 1.0
    shift: float | None = None
    shift_unit: str | None = None
    from_ground_truth: bool = False
    parts: tuple[ScalePart, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The facts as nested plain values, for ``report.json``."""
        values = asdict(self)
        values["source"] = self.source.value
        values["parts"] = [{**asdict(part), "source": part.source.value} for part in self.parts]
        return values
