# SPDX-License-Identifier: Apache-2.0
"""Poses that no motion confirms leave the result of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tracking_scene import Run, frames, played

from slamdepth.config import Config
from slamdepth.geometry import se3_exp
from slamdepth.mapping.map_keyframe import AnchoredPose

CONFIG = Config.from_dict({"features": {"count": 600}, "bundle": {"final": False}})


def slow_walk() -> Run:
    """The walk at half its speed, so that what is left of it on both sides of a leap lasts for a second."""
    slow = [replace(frame, timestamp_s=2.0 * frame.timestamp_s) for frame in played(frames())]
    return Run(slow, config=CONFIG)


def move(run: Run, first: int, end: int) -> None:
    """Put the log's poses of some frames two metres away, as a wrong place would."""
    far = se3_exp(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    for placed in run.slam._active.frames._placed[first:end]:
        placed.pose = AnchoredPose.of(far @ placed.pose.T_camera_world, placed.pose.keyframe)


def test_a_short_leap_there_and_back_is_withdrawn_and_counted() -> None:
    run = slow_walk()
    move(run, 30, 34)
    times_s = [result.timestamp_s for result in run.results]
    found = run.finish()
    assert found.statistics.withdrawn == 4
    assert found.statistics.tracked == len(found.trajectory) == 60
    assert found.trajectory.timestamps_s.tolist() == times_s[:30] + times_s[34:]
    kept_s = set(found.trajectory.timestamps_s.tolist())
    assert all(keyframe.frame.timestamp_s in kept_s for keyframe in found.keyframes)


def test_a_steady_walk_keeps_every_pose() -> None:
    found = slow_walk().finish()
    assert found.statistics.withdrawn == 0
    assert found.statistics.tracked == len(found.trajectory) == 64
