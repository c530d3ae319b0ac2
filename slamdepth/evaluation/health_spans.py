# SPDX-License-Identifier: Apache-2.0
"""The stretches of a run that are worth a look, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby

import numpy as np

from slamdepth.types import StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Ints

LONG_S = 1.0
"""What lasts shorter is bridged: the camera still shows what it showed before, and moves as it did."""

_PLACED_BY_POINTS = (TrackingStatus.TRACKING, TrackingStatus.RELOCALISED)


class SpanKind(str, Enum):
    """What is wrong with a stretch of a run."""

    NO_MAP = "no map yet"
    LOST = "lost"
    WEAK = "weak tracking"
    LEAP = "leap"
    REGISTERED = "registered by depth only"


@dataclass(frozen=True)
class HealthSpan:
    """A stretch of a run that is worth a look.

    Attributes:
        from_s, to_s: seconds since the first frame.
        kind: what is wrong.
        why: the evidence, one sentence.
    """

    from_s: float
    to_s: float
    kind: SpanKind
    why: str

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.to_s - self.from_s

    def __str__(self) -> str:
        if self.kind is SpanKind.LEAP:
            return f"at {self.to_s:.1f} s"
        return f"{self.from_s:.1f}-{self.to_s:.1f} s"


def find_spans(
    steps: Sequence[StepResult], trajectory: Trajectory, leaps: Ints, weak_inliers: int
) -> tuple[HealthSpan, ...]:
    """All spans of a run in order of time.

    Losses count however short they are, weak and registered stretches from one second on.

    Args:
        steps: one for each frame, in order.
        trajectory: the final path.
        leaps: steps of ``trajectory``, see :func:`slamdepth.evaluation.leaps.find_leaps`.
        weak_inliers: fewer points that agree with a pose make it a weak one.
    """

    def is_weak(step: StepResult) -> bool:
        return step.status in _PLACED_BY_POINTS and step.inliers < weak_inliers

    spans = [
        *_stretches(steps, _has(TrackingStatus.INITIALISING), SpanKind.NO_MAP, _no_map),
        *_stretches(steps, _has(TrackingStatus.LOST), SpanKind.LOST, _lost),
        *_stretches(steps, is_weak, SpanKind.WEAK, _weak, LONG_S),
        *_stretches(steps, _has(TrackingStatus.REGISTERED), SpanKind.REGISTERED, _registered, LONG_S),
        *_leap_spans(steps, trajectory, leaps),
    ]
    return tuple(sorted(spans, key=lambda span: (span.from_s, span.to_s)))


def _has(status: TrackingStatus) -> Callable[[StepResult], bool]:
    return lambda step: step.status is status


def _stretches(
    steps: Sequence[StepResult],
    belongs: Callable[[StepResult], bool],
    kind: SpanKind,
    why: Callable[[Sequence[StepResult]], str],
    least_s: float = 0.0,
) -> list[HealthSpan]:
    """Spans of consecutive frames; each ends where the next frame begins."""
    found = []
    for is_in, group in groupby(range(len(steps)), key=lambda n: belongs(steps[n])):
        at = list(group)
        if not is_in:
            continue
        from_s = steps[at[0]].timestamp_s - steps[0].timestamp_s
        to_s = steps[min(at[-1] + 1, len(steps) - 1)].timestamp_s - steps[0].timestamp_s
        if to_s - from_s >= least_s:
            found.append(HealthSpan(from_s, to_s, kind, why([steps[n] for n in at])))
    return found


def _no_map(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames show too little, or have no depth, to start a map with"


def _lost(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames could not be placed"


def _weak(steps: Sequence[StepResult]) -> str:
    median = int(np.median([step.inliers for step in steps]))
    return f"{len(steps)} frames were placed by {median} map points each (median)"


def _registered(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames were placed by the shape of their depth, without map points"


def _leap_spans(steps: Sequence[StepResult], trajectory: Trajectory, leaps: Ints) -> list[HealthSpan]:
    times_s = trajectory.timestamps_s
    if not len(leaps):
        return []
    start_s = steps[0].timestamp_s if steps else float(times_s[0])
    why = "the frames before and after do not confirm the step"
    return [
        HealthSpan(float(times_s[n]) - start_s, float(times_s[n + 1]) - start_s, SpanKind.LEAP, why)
        for n in leaps
    ]
