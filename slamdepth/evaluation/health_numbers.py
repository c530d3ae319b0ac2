# SPDX-License-Identifier: Apache-2.0
"""The figures that a verdict on a run rests on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.evaluation.health_facts import RunFacts
from slamdepth.evaluation.health_odometry import correction_share, weakest_second
from slamdepth.evaluation.health_spans import HealthSpan, SpanKind, largest_moving_share
from slamdepth.evaluation.leaps import judged_steps
from slamdepth.robust import robust_deviation
from slamdepth.types import StepResult, TrackingStatus


@dataclass(frozen=True)
class HealthNumbers:
    """The figures a verdict rests on; None where they cannot be said.

    Attributes:
        tracked_share: frames with a pose in this map, of all frames.
        outside_share: frames with a pose in a map that never met this one, of all frames.
        lost_share: lost frames, of all frames.
        withdrawn_share: frames whose pose was taken back later, of all frames.
        no_map_share: frames before the map was started, of all frames.
        longest_loss_s: longest stretch of lost frames in seconds.
        leaps: steps that the motion around them contradicts (:func:`slamdepth.evaluation.leaps.find_leaps`).
        judged_step_share: steps short enough in time to be judged, of all.
        weak_share: frames within spans of weak tracking, of the frames of this map, by time.
        registered_share: frames placed by registration of their depth, of the frames of this map.
        frames_per_keyframe: frames of this map for each keyframe.
        loop_closures, loops_refused: loops that were closed, and verified ones that were not believed.
        scale_spread_log: robust standard deviation of the keyframes' votes on the map's scale.
        weakest_second: smallest median of inliers over a second, see
            :func:`slamdepth.evaluation.health_odometry.weakest_second`.
        correction_share: how far a pose was moved after it was first placed, of the path's length, see
            :func:`slamdepth.evaluation.health_odometry.correction_share`.
        maps: maps of the run that never met, this one included.
        moving_share: largest median share, over a span of moving things, of features that move by themselves;
            0 without such a span.
    """

    tracked_share: float | None
    outside_share: float | None
    lost_share: float | None
    withdrawn_share: float | None
    no_map_share: float | None
    longest_loss_s: float
    leaps: int
    judged_step_share: float | None
    weak_share: float | None
    registered_share: float | None
    frames_per_keyframe: float | None
    loop_closures: int
    loops_refused: int
    scale_spread_log: float | None
    weakest_second: float | None
    correction_share: float | None
    maps: int = 1
    moving_share: float = 0.0

    @property
    def missing_share(self) -> float:
        """Frames that are lost, withdrawn or in another map, of all frames."""
        return sum(share or 0.0 for share in (self.lost_share, self.withdrawn_share, self.outside_share))


def measure_health(facts: RunFacts, spans: Sequence[HealthSpan], leaps: int) -> HealthNumbers:
    """The figures of a run.

    Args:
        spans: of :func:`slamdepth.evaluation.health_spans.find_spans`.
        leaps: how many there are.
    """
    steps, run = facts.steps, facts.statistics
    inside = [step for step in steps if step.timestamp_s in facts.members]
    keyframes = sum(step.is_keyframe for step in inside)
    judged = judged_steps(facts.trajectory)
    weak_s = sum(span.duration_s for span in spans if span.kind is SpanKind.WEAK)
    placed_s = len(inside) * facts.frame_s
    votes = np.array(run.scale_votes)

    def share(belongs: Callable[[StepResult], bool]) -> float | None:
        return sum(map(belongs, steps)) / len(steps) if steps else None

    return HealthNumbers(
        tracked_share=run.tracked / run.frames if run.frames else None,
        outside_share=share(lambda step: step.timestamp_s in facts.elsewhere),
        lost_share=share(facts.is_lost),
        withdrawn_share=share(facts.is_withdrawn),
        no_map_share=share(lambda step: step.status is TrackingStatus.INITIALISING),
        longest_loss_s=max((span.duration_s for span in spans if span.kind is SpanKind.LOST), default=0.0),
        leaps=leaps,
        judged_step_share=float(np.mean(judged)) if len(judged) else None,
        weak_share=min(1.0, weak_s / placed_s) if placed_s else None,
        registered_share=(
            sum(step.status is TrackingStatus.REGISTERED for step in inside) / len(inside) if inside else None
        ),
        frames_per_keyframe=len(inside) / keyframes if keyframes else None,
        loop_closures=run.loop_closures,
        loops_refused=run.loops_refused,
        scale_spread_log=robust_deviation(votes) if len(votes) else None,
        weakest_second=weakest_second(facts),
        correction_share=correction_share(facts),
        maps=1 + len(facts.others),
        moving_share=largest_moving_share(facts, spans),
    )
