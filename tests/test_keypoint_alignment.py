# SPDX-License-Identifier: Apache-2.0
"""Keypoints aligned in the images at the end of a run."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from tracking_scene import CAMERA, CONFIG, ate_m, walk

from slamdepth.config import Config, merge
from slamdepth.depth.sensor import SensorDepth
from slamdepth.geometry import invert
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking import Tracker
from slamdepth.types import Trajectory
from slamdepth.typing import Floats


@lru_cache
def finished(align: bool) -> Reconstruction:
    config = Config.from_dict(merge(CONFIG.model_dump(), {"bundle": {"align": align}}))
    with Tracker(CAMERA, depth_model=SensorDepth(), config=config) as tracker:
        for frame in walk()[0]:
            tracker.step(frame)
        return tracker.finish()


def of_keyframes(run: Reconstruction) -> Trajectory:
    times_s = np.array([keyframe.frame.timestamp_s for keyframe in run.keyframes])
    return Trajectory(times_s, np.array([keyframe.T_world_camera for keyframe in run.keyframes]))


def off_px(run: Reconstruction) -> float:
    """How far keypoints of one landmark in two keyframes are from what exact depth and poses say."""
    off = [_off_px(a, b) for a, b in zip(run.keyframes, run.keyframes[1:], strict=False)]
    return float(np.median(np.concatenate(off)))


def _off_px(a: Keyframe, b: Keyframe) -> Floats:
    frames, T_world_camera = walk()
    _, at_a, at_b = np.intersect1d(a.point_rows, b.point_rows, return_indices=True)
    seen = a.point_rows[at_a] >= 0
    px_a, px_b = a.keypoints_px[at_a[seen]], b.keypoints_px[at_b[seen]]
    depth_m = frames[a.frame.index].depth_m
    assert depth_m is not None
    u, v = np.rint(px_a).astype(int).T
    rays = np.column_stack([(px_a - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(px_a))])
    T = invert(T_world_camera[b.frame.index]) @ T_world_camera[a.frame.index]
    x, y, z = (rays * depth_m[v, u][:, None] @ T[:3, :3].T + T[:3, 3]).T
    truth = np.column_stack([x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy])
    return np.asarray(np.linalg.norm(px_b - truth, axis=1))


def test_aligned_keypoints_lie_where_exact_geometry_says() -> None:
    assert off_px(finished(True)) < 0.4 * off_px(finished(False))


def test_keyframes_are_no_farther_from_the_truth() -> None:
    # over so short a way other errors count as much; benchmarks measure what is gained
    aligned, detected = (ate_m(of_keyframes(finished(align))) for align in (True, False))
    assert aligned < 1.05 * detected


def test_no_frame_and_few_points_are_lost() -> None:
    aligned, detected = finished(True), finished(False)
    np.testing.assert_array_equal(aligned.trajectory.timestamps_s, detected.trajectory.timestamps_s)
    assert len(aligned.points_m) > 0.85 * len(detected.points_m)
