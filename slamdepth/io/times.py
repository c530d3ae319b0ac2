# SPDX-License-Identifier: Apache-2.0
"""Recognition of the unit of times in a file: seconds, milliseconds, microseconds or nanoseconds.

The evidence is what a header states, the magnitude of Unix times, and the spacing, since a camera takes
between one image in two seconds and a thousand a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CAMERA_STEPS_S = (1e-3, 2.0)
_EPOCH_S = (6e8, 4.2e9)
"""Unix times of the years 1989 to 2103."""
_EPOCH_STEPS_S = (1e-4, 600.0)
"""Unix times may also be those of motion capture or of a time-lapse."""
_LEAST_STEP_S = 1e-5
_NOTED_STEP_S = 8.0
"""Seconds between images that could as well be milliseconds, of 125 images a second and fewer."""

_USUAL_RATES_HZ = (
    1, 2, 3, 4, 5, 6, 7.5, 8, 10, 12, 12.5, 15, 20, 24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120, 144,
    200, 240, 250, 480, 500,
)  # fmt: skip
_RATE_TOLERANCE = 0.03
_REGULAR = 0.15
"""Median deviation of the steps of all frames from their median, as a share; keyframes vary more."""
_BETTER = 10.0


class TimeUnit(Enum):
    """A unit of time, by its symbol and the decimal places between it and the second."""

    SECONDS = ("s", 0)
    MILLISECONDS = ("ms", 3)
    MICROSECONDS = ("us", 6)
    NANOSECONDS = ("ns", 9)

    @property
    def symbol(self) -> str:
        return self.value[0]

    @property
    def places(self) -> int:
        return self.value[1]

    @property
    def words(self) -> str:
        return self.name.lower()


@dataclass(frozen=True)
class UnitVerdict:
    """The unit of a column of times.

    Attributes:
        unit: the likely unit; None where no unit makes sense of the times.
        is_sure: False where the spacing alone would allow another unit.
        note: what a reader should know of the decision; empty where nothing is unusual.
    """

    unit: TimeUnit | None
    is_sure: bool
    note: str = ""


@dataclass(frozen=True)
class TimeColumn:
    """Times as a file writes them, in a unit that is not known yet.

    Attributes:
        texts: ``N`` finite decimal numbers that do not decrease.
        stated: the unit that a header names, or None.
    """

    texts: tuple[str, ...]
    stated: TimeUnit | None = None

    @property
    def values(self) -> NDArray[np.float64]:
        """The numbers ``(N,)`` as written."""
        return np.array([float(text) for text in self.texts], dtype=np.float64)

    @property
    def step(self) -> float:
        """Median difference of neighbours; 0 for fewer than three times."""
        return float(np.median(np.diff(self.values))) if len(self.texts) > 2 else 0.0

    def seconds(self, unit: TimeUnit) -> NDArray[np.float64]:
        """The times ``(N,)`` in seconds: of each exact decimal value the nearest float64."""
        if unit is TimeUnit.SECONDS:
            return self.values
        return np.array([float(Decimal(text).scaleb(-unit.places)) for text in self.texts], dtype=np.float64)


def judge_unit(column: TimeColumn, *, of_images: bool, fps: float | None = None) -> UnitVerdict:
    """Find the unit of ``column``.

    Args:
        of_images: the times are of the images of a camera; poses may be of keyframes only.
        fps: the nominal frame rate in Hz, where one is known.
    """
    stated = column.stated
    if stated is None:
        return _by_values(column, of_images, fps)
    epoch, step_s = _epoch_unit(column), column.step / 10**stated.places
    if epoch is None or epoch is stated or not step_s or _LEAST_STEP_S <= step_s <= _EPOCH_STEPS_S[1]:
        return UnitVerdict(stated, True)
    note = f"the header says {stated.words}, but the times are {epoch.words} since 1970"
    return UnitVerdict(epoch, True, note)


def settle_unit(
    column: TimeColumn, verdict: UnitVerdict, reference_s: NDArray[np.float64] | None
) -> UnitVerdict:
    """Let the times ``(M,)`` of another list of the same recording decide where ``verdict`` is not sure.

    The unit changes only where another makes the two far better coincide.
    """
    if verdict.is_sure or verdict.unit is None or reference_s is None or not len(reference_s):
        return verdict
    fits = {
        unit: _coincidence(column.seconds(unit), reference_s)
        for unit in TimeUnit
        if _within(column.step / 10**unit.places, _EPOCH_STEPS_S)
    }
    best = max(fits, key=lambda unit: fits[unit], default=verdict.unit)
    return UnitVerdict(best, True) if fits.get(best, 0) > _BETTER * fits.get(verdict.unit, 0) else verdict


def conversion_notes(name: str, column: TimeColumn, verdict: UnitVerdict) -> list[str]:
    """Lines on the unit of the times in the file ``name``; none for seconds as they should be."""
    notes = [f"{name}: {verdict.note}"] if verdict.note else []
    if verdict.unit is not None and verdict.unit is not TimeUnit.SECONDS:
        why = "as its header says" if column.stated is verdict.unit else "by their size and spacing"
        step = f", steps of {_exact_step(column):g}" if column.step else ""
        notes.append(
            f"{name}: times are in {verdict.unit.words} {why} ({column.texts[0]} and on{step}); divided by "
            f"1e{verdict.unit.places} to seconds"
        )
    return notes


def _exact_step(column: TimeColumn) -> Decimal:
    """Median difference of neighbours, without the rounding of large numbers to float64."""
    times = [Decimal(text) for text in column.texts]
    steps = sorted(later - earlier for earlier, later in pairwise(times))
    return steps[len(steps) // 2]


def _by_values(column: TimeColumn, of_images: bool, fps: float | None) -> UnitVerdict:
    epoch, step = _epoch_unit(column), column.step
    if epoch is not None:
        return UnitVerdict(epoch, True)
    size = float(np.median(np.abs(column.values)))
    if not step:
        return UnitVerdict(TimeUnit.SECONDS if size <= _EPOCH_S[1] else None, False)
    possible = [
        unit
        for unit in TimeUnit
        if _within(step / 10**unit.places, _CAMERA_STEPS_S) and size / 10**unit.places <= _EPOCH_S[1]
    ]
    if TimeUnit.SECONDS in possible:
        return UnitVerdict(TimeUnit.SECONDS, step < 1.0)
    if not possible:
        return UnitVerdict(TimeUnit.SECONDS if size <= _EPOCH_S[1] else None, False)
    if possible == [TimeUnit.MILLISECONDS] and not _is_milliseconds(column, of_images, fps):
        note = ""
        if step >= _NOTED_STEP_S:
            note = (
                f"times lie {step:.4g} apart and are taken for seconds; if they are milliseconds, write a "
                "first line '# timestamp [ms]'"
            )
        return UnitVerdict(TimeUnit.SECONDS, False, note)
    # A step of 2000 is one image in two seconds, or motion capture at 500 Hz in the finer unit.
    return UnitVerdict(possible[0 if of_images else -1], len(possible) == 1)


def _epoch_unit(column: TimeColumn) -> TimeUnit | None:
    """The unit in which the times are of 1989 to 2103 and lie as far apart as measurements do."""
    size, step = float(np.median(np.abs(column.values))), column.step
    for unit in TimeUnit:
        of_epoch = _within(size / 10**unit.places, _EPOCH_S)
        if of_epoch and (not step or _within(step / 10**unit.places, _EPOCH_STEPS_S)):
            return unit
    return None


def _is_milliseconds(column: TimeColumn, of_images: bool, fps: float | None) -> bool:
    """Whether steps of 2 to 1000, of times that count from zero, are a camera's milliseconds rather than the
    seconds of a time-lapse, of keyframes, or numbers of frames."""
    values, step = column.values, column.step
    steps = np.diff(values)
    deviation = np.abs(steps - step)
    is_whole = bool((values == np.rint(values)).all())
    if is_whole and float(deviation.max()) > 1e-6 * step:  # rounded: 33, 33, 34
        return float(np.median(deviation)) <= _REGULAR * step
    rate_hz = 1e3 / step
    if fps is not None and of_images and abs(rate_hz / fps - 1.0) <= _RATE_TOLERANCE:
        return True
    if not any(abs(rate_hz / usual - 1.0) <= _RATE_TOLERANCE for usual in _USUAL_RATES_HZ):
        return False
    if is_whole:  # such as 40 and 80, but seconds are often written as 20.000000
        return of_images and not any("." in text for text in column.texts)
    return of_images or float(np.median(deviation)) <= 0.01 * step


def _coincidence(first_s: NDArray[np.float64], second_s: NDArray[np.float64]) -> float:
    """Share of the first times within the range of the second, times the reverse; 0 to 1."""
    inside = [
        float(np.mean((a >= b.min() - 0.02) & (a <= b.max() + 0.02)))
        for a, b in ((first_s, second_s), (second_s, first_s))
    ]
    return inside[0] * inside[1]


def _within(value: float, limits: tuple[float, float]) -> bool:
    # A step of exactly a limit, such as 2000 us, must not be lost to rounding.
    return limits[0] * (1 - 1e-9) <= value <= limits[1] * (1 + 1e-9)
