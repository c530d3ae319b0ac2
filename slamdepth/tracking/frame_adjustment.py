# SPDX-License-Identifier: Apache-2.0
"""Frames of a recording in a map that does not change, adjusted together.

A frame is placed by landmarks as the map has them, and shares their errors with the frames about it. Here
poses and landmarks are adjusted together, by what the frames and all keyframes of the map see of the
landmarks, while the keyframes stay: so frames correct one another, and the map holds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem, BundleResult
from slamdepth.config import Config
from slamdepth.frontend.pose import refine_pose
from slamdepth.mapping.map_view import MapView
from slamdepth.mapping.observations import Observations
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.frame_sights import FEWEST_SIGHTS, FrameSights
from slamdepth.types import Camera
from slamdepth.typing import Bools, Ints

_STEPS = (3, 5)
_MOST = 600  # frames that are adjusted; those between them are refined in the landmarks that come out
_LEAST_SHARE = 0.5  # of what a frame saw, that has to agree with its new pose


def adjust_frames(frames: FrameLog, map_: MapView, camera: Camera, config: Config, readout_s: float) -> None:
    """Adjust the poses of all placed frames; the map does not change.

    Args:
        camera: of the frames.
        readout_s: of the rolling shutter, 0 for a global one.
    """
    step = -(-len(frames) // _MOST)
    # what a pose was corrected for depends on those before and after it: all are taken as they are now
    every = [frames.sights(n, readout_s) for n in range(len(frames))]
    fewest = config.tracking.min_inliers
    chosen = [n for n in range(0, len(every), max(step, 1)) if len(every[n]) >= fewest]
    if not chosen:
        return
    group = _Group.of(map_, camera, config, [every[n] for n in chosen])
    result = bundle_adjust(group.problem, _STEPS)
    first = group.keyframes
    for k, n in enumerate(chosen, start=first):
        agrees = result.inlier[group.problem.obs_camera == k]
        if agrees.mean() >= _LEAST_SHARE:
            frames.move(n, result.T_camera_world[k], every[n])
    for n in sorted(set(range(len(every))) - set(chosen)):
        if len(every[n]) >= FEWEST_SIGHTS:
            _refine(frames, n, every[n], camera, group, result)


def _refine(
    frames: FrameLog, n: int, sights: FrameSights, camera: Camera, group: _Group, result: BundleResult
) -> None:
    """Refine a frame's pose in the adjusted landmarks that it sees."""
    row = group.rows[sights.landmark_ids]
    at = np.flatnonzero(row >= 0)
    if len(at) < FEWEST_SIGHTS:
        return
    estimate = refine_pose(
        camera.without_distortion(),
        sights.T_camera_world,
        result.points_w[row[at]],
        result.covariance_w[row[at]],
        sights.px[at],
        sights.sigma_px[at],
        rounds=2,
        iterations=2,
    )
    if estimate.inliers.mean() >= _LEAST_SHARE:
        frames.move(n, estimate.T_camera_world, sights)


@dataclass(frozen=True)
class _Group:
    """Frames, landmarks that they see, and the keyframes that see those too.

    Attributes:
        problem: keyframes first.
        keyframes: how many.
        rows: ``(L,)`` of each landmark of the map in the points of the problem, -1 for none.
    """

    problem: BundleProblem
    keyframes: int
    rows: Ints

    @classmethod
    def of(cls, map_: MapView, camera: Camera, config: Config, frames: Sequence[FrameSights]) -> _Group:
        seen = np.concatenate([frame.landmark_ids for frame in frames])
        ids = np.unique(seen)
        rows = np.full(map_.size, -1)
        rows[ids] = np.arange(len(ids))
        keyframes = [map_.keyframes[k] for k in np.flatnonzero(map_.shared_landmarks(ids)).tolist()]
        before = Observations.of(keyframes, ids, map_.size)
        count, none = len(keyframes), np.full(len(seen), np.nan)
        of_frame = np.repeat(np.arange(len(frames)), [len(frame.landmark_ids) for frame in frames])
        is_fixed: Bools = np.arange(count + len(frames)) < count
        is_sensor = map_.is_measured
        poses = [k.T_camera_world for k in keyframes] + [frame.T_camera_world for frame in frames]
        problem = BundleProblem(
            camera=camera.without_distortion(),
            T_camera_world=np.stack(poses),
            fixed=is_fixed,
            points_w=map_.landmarks.position_w[ids],
            obs_camera=np.concatenate([before.keyframe, count + of_frame]),
            obs_point=np.concatenate([before.landmark, rows[seen]]),
            px=np.concatenate([before.px, *(frame.px for frame in frames)]),
            sigma_px=np.concatenate([before.sigma_px, *(frame.sigma_px for frame in frames)]),
            log_depth=np.concatenate([before.log_depth, none]),
            sigma_log=np.concatenate(
                [before.sigma_log * (1.0 if is_sensor else config.bundle.prior_inflation), none]
            ),
            sigma_scale=0.0 if is_sensor else config.bundle.scale_sigma,
        )
        return cls(problem, count, rows)
