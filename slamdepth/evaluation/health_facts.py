# SPDX-License-Identifier: Apache-2.0
"""What a run, and each of its maps, knows of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slamdepth.types import RunStatistics, StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Floats


@dataclass(frozen=True)
class MapFacts:
    """A further map of a run, which never met the judged one.

    Attributes:
        trajectory: its path in its own frame.
        points_w: ``(P, 3)`` its points in that frame, in the unit of its path.
        statistics: counts of what is in it.
    """

    trajectory: Trajectory
    points_w: Floats
    statistics: RunStatistics


@dataclass(frozen=True)
class RunFacts:
    """What a run knows of itself.

    Attributes:
        steps: one for each frame, in order; empty where they were not kept.
        trajectory: the final path, of the largest map where there are several.
        points_w: ``(P, 3)`` map points, world frame, in the unit of the path.
        statistics: counts of the run.
        depth_is_measured: True where a sensor measured the depth.
        least_inliers: with fewer inliers the tracker takes a frame for lost.
        others: the maps that never met this one, the largest first.
        scale_is_known: False where nothing is known of the size of the path.
        camera_is_guessed: True where the focal length was guessed and the motion does not show it.
        first_s: time that spans are counted from; None: that of the first frame.
    """

    steps: Sequence[StepResult]
    trajectory: Trajectory
    points_w: Floats
    statistics: RunStatistics
    depth_is_measured: bool
    least_inliers: int = 20
    others: Sequence[MapFacts] = ()
    scale_is_known: bool = True
    camera_is_guessed: bool = False
    first_s: float | None = None

    @property
    def frame_s(self) -> float:
        """Median time between two frames in seconds; 0 for fewer than two."""
        times_s = [step.timestamp_s for step in self.steps]
        return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0

    @property
    def start_s(self) -> float:
        """Time that spans are counted from."""
        if self.first_s is not None:
            return self.first_s
        if self.steps:
            return self.steps[0].timestamp_s
        return float(self.trajectory.timestamps_s[0]) if len(self.trajectory) else 0.0

    @cached_property
    def members(self) -> frozenset[float]:
        """Times of the frames in this map."""
        return frozenset(self.trajectory.timestamps_s.tolist())

    @cached_property
    def elsewhere(self) -> frozenset[float]:
        """Times of the frames in the other maps."""
        return frozenset(t for one in self.others for t in one.trajectory.timestamps_s.tolist())

    def is_lost(self, step: StepResult) -> bool:
        """Whether a frame was lost, and not placed afterwards."""
        return step.status is TrackingStatus.LOST and not self._is_placed(step)

    def is_withdrawn(self, step: StepResult) -> bool:
        """Whether the pose that a step gave is in no map of the result."""
        return step.T_world_camera is not None and not self._is_placed(step)

    def _is_placed(self, step: StepResult) -> bool:
        return step.timestamp_s in self.members or step.timestamp_s in self.elsewhere

    def of_each_map(self) -> list[RunFacts]:
        """What the run knows of each map, the judged one first: its frames from its first to its last."""
        own = MapFacts(self.trajectory, self.points_w, self.statistics)
        maps = (own, *self.others)
        return [self._of_map(one, tuple(other for other in maps if other is not one)) for one in maps]

    def _of_map(self, one: MapFacts, others: tuple[MapFacts, ...]) -> RunFacts:
        times_s = one.trajectory.timestamps_s
        steps = [
            step for step in self.steps if len(times_s) and times_s[0] <= step.timestamp_s <= times_s[-1]
        ]
        counts = replace(one.statistics, frames=len(steps) or len(times_s), tracked=len(times_s))
        return replace(
            self,
            steps=steps,
            trajectory=one.trajectory,
            points_w=one.points_w,
            statistics=counts,
            others=others,
            first_s=self.start_s,
        )
