# SPDX-License-Identifier: Apache-2.0
"""What a verdict on a run rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.evaluation.health_spans import HealthSpan, SpanKind
from slamdepth.evaluation.leaps import judged_steps
from slamdepth.types import RunStatistics, StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Floats


@dataclass(frozen=True)
class RunFacts:
    """What a run knows of itself.

    Attributes:
        steps: one for each frame, in order; empty where they were not kept.
        trajectory: the final path.
        points_w: ``(P, 3)`` map points, world frame, in the unit of the path.
        statistics: counts of the run.
        depth_is_measured: True where a sensor measured the depth.
        least_inliers: with fewer inliers the tracker takes a frame for lost.
    """

    steps: Sequence[StepResult]
    trajectory: Trajectory
    points_w: Floats
    statistics: RunStatistics
    depth_is_measured: bool
    least_inliers: int = 20

    @property
    def frame_s(self) -> float:
        """Median time between two frames in seconds; 0 for fewer than two."""
        times_s = [step.timestamp_s for step in self.steps]
        return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


@dataclass(frozen=True)
class HealthNumbers:
    """The figures a verdict rests on; None where they cannot be said.

    Attributes:
        tracked_share: frames with a pose, of all frames.
        lost_share: lost frames, of all frames.
        no_map_share: frames before the map was started, of all frames.
        longest_loss_s: longest stretch of lost frames in seconds.
        leaps: steps that the motion around them contradicts (:func:`slamdepth.evaluation.leaps.find_leaps`).
        judged_step_share: steps short enough in time to be judged, of all.
        weak_share: frames within spans of weak tracking, of the frames with a pose, by time.
        registered_share: frames placed by registration of their depth, of the frames with a pose.
        frames_per_keyframe: frames with a pose for each keyframe.
        loop_closures, loops_refused: loops that were closed, and verified ones that were not believed.
        scale_spread_log: robust standard deviation of the keyframes' votes on the map's scale.
    """

    tracked_share: float | None
    lost_share: float | None
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


def measure_health(facts: RunFacts, spans: Sequence[HealthSpan], leaps: int) -> HealthNumbers:
    """The figures of a run.

    Args:
        spans: of :func:`slamdepth.evaluation.health_spans.find_spans`.
        leaps: how many there are.
    """
    steps, run = facts.steps, facts.statistics
    placed = sum(step.T_world_camera is not None for step in steps)
    keyframes = sum(step.is_keyframe for step in steps)
    judged = judged_steps(facts.trajectory)
    weak_s = sum(span.duration_s for span in spans if span.kind is SpanKind.WEAK)
    placed_s = placed * facts.frame_s
    votes = np.array(run.scale_votes)

    def share(status: TrackingStatus, of: int) -> float | None:
        return sum(step.status is status for step in steps) / of if of else None

    return HealthNumbers(
        tracked_share=run.tracked / run.frames if run.frames else None,
        lost_share=share(TrackingStatus.LOST, len(steps)),
        no_map_share=share(TrackingStatus.INITIALISING, len(steps)),
        longest_loss_s=max((span.duration_s for span in spans if span.kind is SpanKind.LOST), default=0.0),
        leaps=leaps,
        judged_step_share=float(np.mean(judged)) if len(judged) else None,
        weak_share=min(1.0, weak_s / placed_s) if placed_s else None,
        registered_share=share(TrackingStatus.REGISTERED, placed),
        frames_per_keyframe=placed / keyframes if keyframes else None,
        loop_closures=run.loop_closures,
        loops_refused=run.loops_refused,
        scale_spread_log=1.4826 * float(np.median(np.abs(votes - np.median(votes)))) if len(votes) else None,
    )
