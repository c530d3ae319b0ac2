# SPDX-License-Identifier: Apache-2.0
"""What a made-up run knows of itself, for the tests of the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamdepth.evaluation import Health, MapHealth, RunFacts, SpanKind
from slamdepth.geometry import se3_exp
from slamdepth.types import RunStatistics, StepResult, TrackingStatus, Trajectory
from slamdepth.typing import Floats

FPS = 30.0
COUNT = 300
SCENE_M = 2.0


def walk(count: int = COUNT, speed_m: float = 0.005, turn_rad: float = 0.004) -> Floats:
    """Poses ``(count, 4, 4)`` of a camera that goes sideways and turns, with a hand's jitter."""
    n = np.arange(count)
    jitter = np.random.default_rng(0).normal(size=(count, 6)) * 2e-4
    zero = np.zeros(count)
    tangents = np.stack([speed_m * n, zero, zero, zero, turn_rad * n, zero], axis=1)
    return se3_exp(tangents + jitter)


def wall() -> Floats:
    """Points around the path of :func:`walk`, two metres away."""
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(4000, 3))
    points: Floats = SCENE_M * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return points


def facts(
    poses: Floats | None = None,
    states: Sequence[TrackingStatus] | None = None,
    inliers: Sequence[int] | int = 200,
    keyframe_every: int = 10,
    fps: float = FPS,
    *,
    depth_is_measured: bool = False,
    statistics: RunStatistics | None = None,
) -> RunFacts:
    """A run of a path; frames that are lost leave no pose. Times begin late, as a recording's often do."""
    poses = walk() if poses is None else poses
    count = len(poses)
    states = [TrackingStatus.TRACKING] * count if states is None else states
    counts = [inliers] * count if isinstance(inliers, int) else inliers
    unplaced = (TrackingStatus.LOST, TrackingStatus.INITIALISING)
    steps = tuple(
        StepResult(
            n,
            1.3e9 + n / fps,
            states[n],
            None if states[n] in unplaced else poses[n],
            counts[n],
            is_keyframe=n % keyframe_every == 0,
        )
        for n in range(count)
    )
    placed = [step for step in steps if step.T_world_camera is not None]
    trajectory = Trajectory(
        np.array([step.timestamp_s for step in placed]),
        poses[[step.index for step in placed]],
    )
    statistics = replace(statistics or RunStatistics(), frames=count, tracked=len(placed))
    return RunFacts(steps, trajectory, wall(), statistics, depth_is_measured)


def states(count: int, *changes: tuple[int, int, TrackingStatus]) -> list[TrackingStatus]:
    """Tracked frames, but for ``(first, behind the last, status)`` stretches."""
    made = [TrackingStatus.TRACKING] * count
    for first, end, status in changes:
        made[first:end] = [status] * (end - first)
    return made


def kinds(health: Health | MapHealth) -> list[SpanKind]:
    return [span.kind for span in health.spans]


def moved_from(poses: Floats, n: int, shift_m: float, end: int | None = None) -> Floats:
    """The path with all poses from the ``n``-th on (up to ``end``) moved sideways."""
    poses = poses.copy()
    poses[n:end, 1, 3] += shift_m
    return poses
