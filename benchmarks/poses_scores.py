# SPDX-License-Identifier: Apache-2.0
"""Covariances and qualities of poses, judged by true poses.

What is judged is motion, from a frame to a later one: where the world's origin is and how the map drifted
before is not part of a pose's covariance. The unit of length is fitted locally, over three seconds before and
after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamdepth.geometry import invert, skew, so3_exp, so3_log
from slamdepth.tracking.pose_uncertainty import GOOD_RAD, GOOD_SHARE
from slamdepth.types import StepResult, Trajectory
from slamdepth.typing import Bools, Floats, Ints

SPANS_S = (0.0, 1 / 3, 1.0)
"""Durations of the judged motions; 0 is from a frame to the next."""
GOOD_QUALITY = 0.5
"""Poses of more quality are called good."""

_CHI2_6DOF = (7.0384, 12.8489, 20.0622)  # 68.27, 95.45 and 99.73 %
_CHI2_6DOF_MEDIAN = 5.3481
_SCALE_S = 3.0
_MAX_GAP_S = 0.1  # between true poses
_SLACK = 0.25  # of a span, for frames that lie not quite so far apart


@dataclass(frozen=True)
class TruthError:
    """Standard deviations of the true poses themselves.

    Attributes:
        time_s: of the clock of images against that of the poses, which includes the shutter's.
        position_m, rotation_rad: of each pose and axis.
    """

    time_s: float = 0.0
    position_m: float = 0.0
    rotation_rad: float = 0.0


EXACT = TruthError()
MOTION_CAPTURE = TruthError(0.005, 0.001, np.radians(0.1))
"""Of tracked cameras: milliseconds, millimetres and tenths of a degree."""


@dataclass(frozen=True)
class Poses:
    """The placed frames of a run that have a true pose, ``N`` of them.

    Attributes:
        times_s: ``(N,)``.
        estimate, truth: ``(N, 4, 4)`` T_world_camera, each in its own world and unit.
        covariance: ``(N, 6, 6)`` of ``estimate``, NaN where a frame has none.
        quality: ``(N,)``.
    """

    times_s: Floats
    estimate: Floats
    truth: Floats
    covariance: Floats
    quality: Floats

    @classmethod
    def of(cls, steps: Sequence[StepResult], truth: Trajectory) -> Poses:
        """Placed frames of ``steps``, with the true poses interpolated at their times."""
        placed = [step for step in steps if step.T_world_camera is not None]
        times_s = np.array([step.timestamp_s for step in placed])
        true, known = interpolated(truth, times_s)
        unknown = np.full((6, 6), np.nan)
        covariance = [unknown if step.covariance is None else step.covariance for step in placed]
        return cls(
            times_s[known],
            np.array([step.T_world_camera for step in placed]).reshape(-1, 4, 4)[known],
            true[known],
            np.array(covariance).reshape(-1, 6, 6)[known],
            np.array([step.quality for step in placed])[known],
        )

    def __len__(self) -> int:
        return len(self.times_s)


def interpolated(truth: Trajectory, times_s: Floats) -> tuple[Floats, Bools]:
    """Poses ``(N, 4, 4)`` at ``times_s (N,)``, and where they are known: between poses 0.1 s apart at most,
    or at the time of one to a millisecond."""
    after = np.clip(np.searchsorted(truth.timestamps_s, times_s), 1, len(truth) - 1)
    t0, t1 = truth.timestamps_s[after - 1], truth.timestamps_s[after]
    T0, T1 = truth.T_world_camera[after - 1], truth.T_world_camera[after]
    share = np.clip((times_s - t0) / (t1 - t0), 0.0, 1.0)[:, None]
    T = np.tile(np.eye(4), (len(times_s), 1, 1))
    turn = so3_log(np.swapaxes(T0[:, :3, :3], 1, 2) @ T1[:, :3, :3])
    T[:, :3, :3] = T0[:, :3, :3] @ so3_exp(share * turn)
    T[:, :3, 3] = (1.0 - share) * T0[:, :3, 3] + share * T1[:, :3, 3]
    off = np.minimum(np.abs(times_s - t0), np.abs(times_s - t1))
    is_between = (t1 - t0 <= _MAX_GAP_S) & (times_s >= t0) & (times_s <= t1)
    return T, is_between | (off < 1e-3)


@dataclass(frozen=True)
class Motions:
    """Motions between frames and their errors, ``M`` of them, in the true unit.

    Attributes:
        first, last: ``(M,)`` indices of the frames.
        errors: ``(M, 6)`` ``(translation, rotation)`` in the axes of the last camera.
        covariance: ``(M, 6, 6)`` of those, by the covariances of both poses and the error of the truth.
    """

    first: Ints
    last: Ints
    errors: Floats
    covariance: Floats

    def squared(self) -> Floats:
        """``(K,)`` normalised squared errors of motions with a covariance: chi-square, six degrees of
        freedom."""
        at = np.flatnonzero(np.isfinite(self.covariance).all(axis=(1, 2)))
        solved = np.linalg.solve(self.covariance[at], self.errors[at][:, :, None])[:, :, 0]
        return np.asarray(np.einsum("ni,ni->n", self.errors[at], solved))


def local_scales(poses: Poses) -> Floats:
    """``(N,)`` metres of the truth per metre of the estimate around each frame, by least squares over motions
    of a third of a second."""
    first, last = pairs(poses.times_s, 1 / 3)
    if len(first) == 0:
        return np.ones(len(poses))
    ours = (invert(poses.estimate[first]) @ poses.estimate[last])[:, :3, 3]
    true = (invert(poses.truth[first]) @ poses.truth[last])[:, :3, 3]
    both, own = np.sum(ours * true, axis=1), np.sum(ours * ours, axis=1)
    scales = np.empty(len(poses))
    for n, time_s in enumerate(poses.times_s):
        near = np.abs(poses.times_s[last] - time_s) <= _SCALE_S
        scales[n] = both[near].sum() / own[near].sum() if own[near].sum() > 0 else np.nan
    whole = both.sum() / max(own.sum(), 1e-300)
    return np.where(np.isfinite(scales) & (scales > 0), scales, whole)


def pairs(times_s: Floats, span_s: float) -> tuple[Ints, Ints]:
    """Frames and the frames ``span_s`` later, as two index arrays; to the next frame for a span of 0."""
    if span_s == 0.0:
        first = np.arange(len(times_s) - 1)
        is_next = np.diff(times_s) < 1.5 * np.median(np.diff(times_s)) if len(times_s) > 1 else first > 0
        return first[is_next], first[is_next] + 1
    first = np.arange(len(times_s))
    last = np.clip(np.searchsorted(times_s, times_s + span_s - 1e-6), 0, len(times_s) - 1)
    ok = np.abs(times_s[last] - times_s - span_s) < _SLACK * span_s
    return first[ok], last[ok]


def motions(poses: Poses, span_s: float, scales: Floats, truth_error: TruthError = EXACT) -> Motions:
    """All motions over ``span_s`` and their errors; ``scales (N,)`` by :func:`local_scales`."""
    first, last = pairs(poses.times_s, span_s)
    scale = scales[last][:, None]
    ours = invert(poses.estimate[first]) @ poses.estimate[last]
    ours[:, :3, 3] *= scale
    true = invert(poses.truth[first]) @ poses.truth[last]
    off = invert(true) @ ours
    errors = np.hstack([off[:, :3, 3], so3_log(off[:, :3, :3])])
    of_last = _in_camera(poses.covariance[last], poses.estimate[last], scales[last])
    of_first = _in_camera(poses.covariance[first], poses.estimate[first], scales[last])
    # an error of the first pose, seen from the last: the adjoint of the motion back
    back = invert(ours)
    adjoint = np.zeros((len(first), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = back[:, :3, :3]
    adjoint[:, :3, 3:] = skew(back[:, :3, 3]) @ back[:, :3, :3]
    of_truth = _truth_covariance(poses, truth_error)
    covariance = of_last + of_truth[last]
    covariance = covariance + adjoint @ (of_first + of_truth[first]) @ np.swapaxes(adjoint, 1, 2)
    return Motions(first, last, errors, covariance)


def _in_camera(covariance: Floats, T_world_camera: Floats, scale: Floats) -> Floats:
    """Covariances ``(M, 6, 6)`` in the axes of the cameras and the true unit."""
    to_camera = np.zeros((len(covariance), 6, 6))
    R = np.swapaxes(T_world_camera[:, :3, :3], 1, 2)
    to_camera[:, :3, :3], to_camera[:, 3:, 3:] = R * scale[:, None, None], R
    return to_camera @ covariance @ np.swapaxes(to_camera, 1, 2)


def _truth_covariance(poses: Poses, error: TruthError) -> Floats:
    """``(N, 6, 6)`` of the true poses, in the axes of their cameras."""
    n = len(poses)
    velocity = np.zeros((n, 6))
    if n > 1:
        step = invert(poses.truth[:-1]) @ poses.truth[1:]
        moved = np.hstack([step[:, :3, 3], so3_log(step[:, :3, :3])]) / np.diff(poses.times_s)[:, None]
        velocity[1:], velocity[0] = moved, moved[0]
    diagonal = np.repeat([error.position_m**2, error.rotation_rad**2], 3)
    moving = error.time_s**2 * velocity[:, :, None] * velocity[:, None, :]
    return np.asarray(np.diag(diagonal) + moving)


def is_bad(poses: Poses, distance: float, scales: Floats, truth_error: TruthError = EXACT) -> Bools:
    """``(N,)`` whether a pose is truly bad: neither the motion over the second before it nor that over the
    second after it is within 2 % of the scene's distance and within 2 degrees, and three deviations of the
    truth.

    Args:
        distance: of the scene in the unit of the estimate.
    """
    moved = motions(poses, 1.0, scales, truth_error)
    of_truth = np.sqrt(_truth_covariance(poses, truth_error)[:, range(6), range(6)])
    slack_m = 3.0 * np.linalg.norm(of_truth[:, :3], axis=1)
    slack_rad = 3.0 * np.linalg.norm(of_truth[:, 3:], axis=1)
    limit_m = GOOD_SHARE * distance * scales[moved.last] + slack_m[moved.last] + slack_m[moved.first]
    limit_rad = GOOD_RAD + slack_rad[moved.last] + slack_rad[moved.first]
    off_m, off_rad = np.linalg.norm(moved.errors[:, :3], axis=1), np.linalg.norm(moved.errors[:, 3:], axis=1)
    agrees = (off_m < limit_m) & (off_rad < limit_rad)
    bad = np.zeros(len(poses), dtype=bool)
    bad[moved.first] = bad[moved.last] = True
    bad[moved.first[agrees]] = bad[moved.last[agrees]] = False
    return bad


def figures(poses: Poses, distance: float, truth_error: TruthError = EXACT) -> dict[str, Any]:
    """The judgement of one run.

    Returns:
        ``spans``: for each of :data:`SPANS_S` the number of motions, the median error as a share of the
        scene's distance and in degrees, the mean and median of the normalised squared error (1 where the
        covariance is right), and the shares within 1, 2 and 3 sigma. ``good``, ``good_bad``, ``poor`` and
        ``poor_bad``: poses called good or not, and those of them that are truly bad.
    """
    scales = local_scales(poses)
    rows = []
    for span_s in SPANS_S:
        moved = motions(poses, span_s, scales, truth_error)
        squared = moved.squared()
        if len(squared) == 0:
            continue
        share = np.linalg.norm(moved.errors[:, :3], axis=1) / (distance * scales[moved.last])
        rows.append(
            {
                "span_s": span_s,
                "motions": len(squared),
                "share": float(np.median(share)),
                "deg": float(np.degrees(np.median(np.linalg.norm(moved.errors[:, 3:], axis=1)))),
                "mean": float(squared.mean() / 6.0),
                "median": float(np.median(squared) / _CHI2_6DOF_MEDIAN),
                "within": [float(np.mean(squared < limit)) for limit in _CHI2_6DOF],
            }
        )
    bad = is_bad(poses, distance, scales, truth_error)
    is_good = poses.quality > GOOD_QUALITY
    return {
        "poses": len(poses),
        "spans": rows,
        "good": int(is_good.sum()),
        "good_bad": int((is_good & bad).sum()),
        "poor": int((~is_good).sum()),
        "poor_bad": int((~is_good & bad).sum()),
    }
