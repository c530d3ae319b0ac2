# SPDX-License-Identifier: Apache-2.0
"""The scale of a finished map from known lengths, a sensor or a ground truth trajectory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.evaluation import score_trajectory
from slamdepth.evaluation.bootstrap import block_resamples
from slamdepth.geometry import umeyama
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import ScaleSource
from slamdepth.scale.estimate import ScaleEstimate
from slamdepth.types import Frame, Trajectory
from slamdepth.typing import Floats

LENGTH_SIGMA_LOG = 0.01
"""Standard deviation of the log of a distance that people measured."""
SENSOR_SIGMA_LOG = 0.03
"""Standard deviation of the log of a Kinect's depth: factors in use for one camera of TUM RGB-D differ by
4 %."""
DRIFT = 0.01
"""Standard deviation of the distance of two positions, as a share of the path between them."""
_MAX_GAP_S = 0.5
_MAX_SIGMA_LOG = 0.3
_FEWEST_POINTS = 20


def rescaled(reconstruction: Reconstruction, factor: float) -> Reconstruction:
    """The reconstruction with every length multiplied by ``factor``.

    Predictions and sensor depth stay as they are; only their scale in the map changes.
    """
    return replace(
        reconstruction,
        trajectory=replace(
            reconstruction.trajectory, T_world_camera=_moved(reconstruction.trajectory.T_world_camera, factor)
        ),
        keyframes=tuple(keyframe.rescaled(factor) for keyframe in reconstruction.keyframes),
        points_m=reconstruction.points_m * factor,
        statistics=replace(
            reconstruction.statistics,
            scale_votes=tuple(vote + math.log(factor) for vote in reconstruction.statistics.scale_votes),
        ),
    )


def _moved(T: Floats, factor: float) -> Floats:
    out: Floats = T.copy()
    out[..., :3, 3] *= factor
    return out


def from_sensor(keyframes: Sequence[Keyframe], frames: Iterable[Frame]) -> ScaleEstimate:
    """Compare the sensor's depth with the map's at the keypoints of every keyframe.

    The scale of predictions is fitted to all pixels. The map is made of those that can be tracked, where the
    error of a network differs.

    Args:
        keyframes: of the finished map.
        frames: the frames of the keyframes, with sensor depth; some may be missing.

    Raises:
        DatasetError: no keyframe has both.
    """
    logs = []
    keyframe_of = {keyframe.frame.index: keyframe for keyframe in keyframes}
    for frame in frames:
        if (sensor_m := frame.depth_m) is None:
            continue
        keyframe = keyframe_of[frame.index]
        u, v = np.rint(keyframe.keypoints_px).astype(np.int64).T
        inside = (u >= 0) & (v >= 0) & (u < sensor_m.shape[1]) & (v < sensor_m.shape[0])
        theirs, ours = sensor_m[v[inside], u[inside]], keyframe.load_depth_m()[v[inside], u[inside]]
        both = (theirs > 0) & (ours > 0)
        if np.count_nonzero(both) >= _FEWEST_POINTS:
            logs.append(float(np.median(np.log(theirs[both]) - np.log(ours[both]))))
    if not logs:
        raise DatasetError("no keyframe has sensor depth at its keypoints")
    medians = np.median(np.array(logs)[block_resamples(len(logs), resamples=200)], axis=1)
    how = f"the sensor's depth at the keypoints of {len(logs)} keyframes"
    sigma_log = math.hypot(SENSOR_SIGMA_LOG, float(np.std(medians)))
    return ScaleEstimate(ScaleSource.GROUND_TRUTH_DEPTH, math.exp(np.median(logs)), sigma_log, how)


def from_baseline(
    trajectory: Trajectory, length_m: float, between_s: tuple[float, float] | None
) -> ScaleEstimate:
    """Compare a known distance between two positions of the camera with that in the map.

    Args:
        trajectory: of the finished map.
        length_m: the known distance in metres.
        between_s: the two times in seconds; None takes the first and the last pose.

    Raises:
        DatasetError: there is no pose near one of the times, or the two positions are too close together,
            in relation to the path between them, to give a scale.
    """
    times_s, positions = trajectory.timestamps_s, trajectory.T_world_camera[:, :3, 3]
    first_s, last_s = (float(times_s[0]), float(times_s[-1])) if between_s is None else between_s
    a, b = (_position_at(times_s, positions, t) for t in (first_s, last_s))
    distance = float(np.linalg.norm(b - a))
    inside = (times_s > first_s) & (times_s < last_s)
    path = np.vstack([a, positions[inside], b])
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    sigma_log = math.hypot(LENGTH_SIGMA_LOG, DRIFT * length / distance) if distance > 0 else math.inf
    if not sigma_log <= _MAX_SIGMA_LOG:
        raise DatasetError(
            f"the camera's positions at {first_s:.3f} and {last_s:.3f} s are {distance:.3f} m apart after "
            f"{length:.2f} m of path: too close to give a scale; name two other times (--baseline-between)"
        )
    how = f"a baseline of {length_m:g} m against {distance:.3f} m between {first_s:.3f} and {last_s:.3f} s"
    return ScaleEstimate(ScaleSource.BASELINE, length_m / distance, sigma_log, how)


def _position_at(times_s: Floats, positions: Floats, time_s: float) -> Floats:
    """Position ``(3,)`` at a time, interpolated between the poses around it."""
    after = int(np.clip(np.searchsorted(times_s, time_s), 0, len(times_s) - 1))
    before = after if times_s[after] <= time_s or after == 0 else after - 1
    gap_s = max(abs(float(times_s[i]) - time_s) for i in (before, after))
    if gap_s > _MAX_GAP_S:
        raise DatasetError(f"no frame was tracked within {_MAX_GAP_S:g} s of {time_s:.3f} s")
    return np.array(
        [np.interp(time_s, times_s[[before, after]], positions[[before, after], i]) for i in range(3)]
    )


def from_ground_truth(ground_truth: Trajectory, estimate: Trajectory) -> ScaleEstimate:
    """The scale of the Sim(3) alignment of ``estimate`` with ``ground_truth``.

    Raises:
        DatasetError: the two cannot be aligned.
    """
    score = score_trajectory(ground_truth, estimate)
    rows = block_resamples(score.matched, resamples=200)
    scales = [umeyama(score.estimate_m[row], score.truth_m[row], with_scale=True)[0] for row in rows]
    sigma_log = float(np.std(np.log(np.maximum(scales, 1e-9))))
    how = f"the Sim(3) alignment of {score.matched} poses with the ground truth's"
    return ScaleEstimate(ScaleSource.GROUND_TRUTH_TRAJECTORY, score.sim3.scale, sigma_log, how)
