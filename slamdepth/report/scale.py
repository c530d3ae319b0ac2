# SPDX-License-Identifier: Apache-2.0
"""The scale of a map, and where it comes from."""

from __future__ import annotations

import math
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
    MARKER = "marker"
    IMU = "imu"


def interval(sigma_log: float) -> tuple[float, float]:
    """Factors between which a length is to one standard deviation ``sigma_log`` of its natural log."""
    return math.exp(-sigma_log), math.exp(sigma_log)


def interval_text(sigma_log: float) -> str:
    """The interval for people, with as many digits as tell it from 1."""
    digits = min(5, max(2, 1 - math.floor(math.log10(max(sigma_log, 1e-4)))))
    low, high = interval(sigma_log)
    return f"{low:.{digits}f} to {high:.{digits}f}"


def accuracy_text(sigma_log: float) -> str:
    """How sure a scale is, in words."""
    return f"{interval_text(sigma_log)} of true metres, two in three"


@dataclass(frozen=True)
class ScalePart:
    """One of several estimates that were combined.

    Attributes:
        source: where it comes from.
        factor: on the depth model's own lengths.
        uncertainty_log: standard deviation of the natural log of ``factor``; None where it is unknown.
        weight: its share in the combination, 0 to 1; 0 where it was left out.
        how: what was compared, as a phrase.
    """

    source: ScaleSource
    factor: float
    uncertainty_log: float | None
    weight: float
    how: str = ""


@dataclass(frozen=True)
class ScaleFacts:
    """The scale of a run.

    Attributes:
        source: where it comes from; of several estimates, the one with the largest weight.
        factor: total factor on the depth model's own lengths; of a relative model, on its numbers.
        sentence: all of this for people.
        uncertainty_log: standard deviation of the natural log of ``factor``; None where it is unknown.
        keyframes: number of keyframes that voted on the map's scale.
        independent: number of independent votes among theirs.
        spread: robust standard deviation of their votes (log ratios of map to predicted depth).
        prediction_factor: the part of ``factor`` that was applied to predictions; the rest was applied to
            the finished map.
        shift, shift_unit: added to the model's numbers after ``prediction_factor``, else None.
        is_unknown: True where nothing is known of the size of the map.
        from_ground_truth: True where the scale was taken from what the run is scored by.
        parts: the estimates that were combined, where there were several.
    """

    source: ScaleSource
    factor: float
    sentence: str
    uncertainty_log: float | None = None
    keyframes: int = 0
    independent: float | None = None
    spread: float | None = None
    prediction_factor: float = 1.0
    shift: float | None = None
    shift_unit: str | None = None
    is_unknown: bool = False
    from_ground_truth: bool = False
    parts: tuple[ScalePart, ...] = ()

    @property
    def interval(self) -> tuple[float, float] | None:
        """Lengths of the map in true metres, lowest and highest in two cases of three; None where unknown."""
        return None if self.uncertainty_log is None else interval(self.uncertainty_log)

    def to_dict(self) -> dict[str, Any]:
        """The facts as nested plain values, for ``report.json``."""
        values = asdict(self)
        values["interval"] = None if self.interval is None else list(self.interval)
        values["source"] = self.source.value
        values["parts"] = [{**asdict(part), "source": part.source.value} for part in self.parts]
        return values


def scale_interval(facts: ScaleFacts) -> str | None:
    """The interval of a run's scale, None where it is unknown."""
    return None if facts.uncertainty_log is None else interval_text(facts.uncertainty_log)


def scale_rows(facts: ScaleFacts) -> list[list[str]]:
    """One row for each estimate that was combined: source, factor, interval, weight, what was compared."""
    return [
        [
            part.source.value,
            f"{part.factor:.4g}",
            "unknown" if part.uncertainty_log is None else interval_text(part.uncertainty_log),
            f"{100 * part.weight:.3g} %" if part.weight > 0 else "left out",
            part.how,
        ]
        for part in facts.parts
    ]
