# SPDX-License-Identifier: Apache-2.0
"""The stretches of a run that are worth a look, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby

import numpy as np

from slamdepth.evaluation.health_facts import RunFacts
from slamdepth.types import StepResult, TrackingStatus
from slamdepth.typing import Ints

LONG_S = 1.0
"""What lasts shorter is bridged: the camera still shows what it showed before, and moves as it did."""

GOOD_SPAN_S = 5.0
"""Shorter stretches are not called good: there is too little path to be wrong about."""

MOVING_SHARE = 0.1
"""Of the features of an image, moving together: static ones have up to 0.03 where poses are right."""

_PLACED_BY_POINTS = (TrackingStatus.TRACKING, TrackingStatus.RELOCALISED)


class SpanKind(str, Enum):
    """What is wrong with a stretch of a run."""

    NO_MAP = "no map yet"
    LOST = "lost"
    WEAK = "weak tracking"
    LEAP = "leap"
    REGISTERED = "registered by depth only"
    WITHDRAWN = "pose withdrawn"
    OTHER_MAP = "in another map"
    MOVING = "moving things"


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


def find_spans(facts: RunFacts, leaps: Ints, weak_inliers: int) -> tuple[HealthSpan, ...]:
    """All spans of a run in order of time.

    Losses, withdrawn poses and other maps count however short they are. Weak and registered stretches count
    from one second on, and shorter ones next to a loss or an end of the map, where nothing bridges them.

    Args:
        leaps: steps of the trajectory, see :func:`slamdepth.evaluation.leaps.find_leaps`.
        weak_inliers: fewer points that agree with a pose make it a weak one.
    """

    def is_elsewhere(step: StepResult) -> bool:
        return step.timestamp_s in facts.elsewhere

    spans = [
        *_stretches(facts, _has(TrackingStatus.INITIALISING), SpanKind.NO_MAP, _no_map),
        *_stretches(facts, facts.is_lost, SpanKind.LOST, _lost),
        *_stretches(facts, facts.is_withdrawn, SpanKind.WITHDRAWN, _withdrawn),
        *_stretches(facts, is_elsewhere, SpanKind.OTHER_MAP, _elsewhere),
        *_badly_held(facts, weak_inliers),
        *_moving_spans(facts),
        *_leap_spans(facts, leaps),
    ]
    return tuple(sorted(spans, key=lambda span: (span.from_s, span.to_s)))


def find_good_spans(facts: RunFacts, spans: Sequence[HealthSpan]) -> tuple[tuple[float, float], ...]:
    """Stretches of at least five seconds with nothing to look at, seconds since the first frame.

    Args:
        spans: of :func:`find_spans`.
    """
    times_s = facts.trajectory.timestamps_s
    if not len(times_s):
        return ()
    edges = [float(times_s[0]) - facts.start_s]
    for span in sorted(spans, key=lambda span: span.from_s):
        edges += [span.from_s, max(span.to_s, *edges)]
    edges.append(float(times_s[-1]) - facts.start_s)
    stretches = zip(edges[::2], edges[1::2], strict=True)
    return tuple((from_s, to_s) for from_s, to_s in stretches if to_s - from_s >= GOOD_SPAN_S)


def _has(status: TrackingStatus) -> Callable[[StepResult], bool]:
    return lambda step: step.status is status


def _stretches(
    facts: RunFacts,
    belongs: Callable[[StepResult], bool],
    kind: SpanKind,
    why: Callable[[Sequence[StepResult]], str],
) -> list[HealthSpan]:
    """Spans of consecutive frames; each ends where the next frame begins."""
    return [
        HealthSpan(*_duration(facts, first, end), kind, why(facts.steps[first:end]))
        for first, end in _runs(facts, belongs)
    ]


def _runs(facts: RunFacts, belongs: Callable[[StepResult], bool]) -> list[tuple[int, int]]:
    """``(first, past the last)`` of each group of consecutive frames that belong."""
    found, first = [], 0
    for is_in, group in groupby(facts.steps, key=belongs):
        end = first + len(list(group))
        if is_in:
            found.append((first, end))
        first = end
    return found


def _duration(facts: RunFacts, first: int, end: int) -> tuple[float, float]:
    """From and to of some frames, seconds since the first frame of the run."""
    last = min(end, len(facts.steps) - 1)
    from_s, to_s = (facts.steps[n].timestamp_s - facts.start_s for n in (first, last))
    return from_s, to_s


def _badly_held(facts: RunFacts, weak_inliers: int) -> list[HealthSpan]:
    """Stretches of frames that few points or only the shape of their depth placed."""

    def is_badly_held(step: StepResult) -> bool:
        is_few = step.status in _PLACED_BY_POINTS and step.inliers < weak_inliers
        return step.timestamp_s in facts.members and (is_few or step.status is TrackingStatus.REGISTERED)

    found = []
    for first, end in _runs(facts, is_badly_held):
        around = [facts.steps[n] for n in (first - 1, end) if 0 <= n < len(facts.steps)]
        is_bridged = len(around) == 2 and all(step.timestamp_s in facts.members for step in around)
        from_s, to_s = _duration(facts, first, end)
        if is_bridged and to_s - from_s < LONG_S:
            continue
        steps = facts.steps[first:end]
        registered = sum(step.status is TrackingStatus.REGISTERED for step in steps)
        kind, why = (
            (SpanKind.REGISTERED, _registered) if 2 * registered > len(steps) else (SpanKind.WEAK, _weak)
        )
        found.append(HealthSpan(from_s, to_s, kind, why(steps)))
    return found


def _no_map(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames show too little, or have no depth, to start a map with"


def _lost(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames could not be placed"


def _withdrawn(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames were placed, and taken out again: what followed did not confirm them"


def _elsewhere(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames are in a map that never met this one"


def _weak(steps: Sequence[StepResult]) -> str:
    median = int(np.median([step.inliers for step in steps]))
    return f"{len(steps)} frames were placed by {median} map points each (median)"


def _registered(steps: Sequence[StepResult]) -> str:
    return f"{len(steps)} frames were placed by the shape of their depth, with hardly a map point"


def _moving_spans(facts: RunFacts) -> list[HealthSpan]:
    """Stretches of a second and more in which much of what is seen moves by itself."""

    def is_moving(step: StepResult) -> bool:
        share = step.moving_share
        return step.timestamp_s in facts.members and share is not None and share >= MOVING_SHARE

    spans = _stretches(facts, is_moving, SpanKind.MOVING, _moving)
    return [span for span in spans if span.duration_s >= LONG_S]


def largest_moving_share(facts: RunFacts, spans: Sequence[HealthSpan]) -> float:
    """The largest median share of moving features over one of the spans of moving things; 0 without any."""
    found = [0.0]
    for span in spans:
        if span.kind is SpanKind.MOVING:
            inside = [
                step.moving_share
                for step in facts.steps
                if step.moving_share is not None
                and span.from_s <= step.timestamp_s - facts.start_s < span.to_s
            ]
            found.append(float(np.median(inside)))
    return max(found)


def _moving(steps: Sequence[StepResult]) -> str:
    share = float(np.median([step.moving_share for step in steps if step.moving_share is not None]))
    return f"{100 * share:.0f} % of the features move together against the static scene (median)"


def _leap_spans(facts: RunFacts, leaps: Ints) -> list[HealthSpan]:
    times_s = facts.trajectory.timestamps_s - facts.start_s
    why = "the frames before and after do not confirm the step"
    return [HealthSpan(float(times_s[n]), float(times_s[n + 1]), SpanKind.LEAP, why) for n in leaps]
