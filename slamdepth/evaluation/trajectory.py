# SPDX-License-Identifier: Apache-2.0
"""Score an estimated trajectory against a ground truth, with evo.

The only module that imports evo, which is GPL-3.0; everything else sees the numbers it returns.
Only ``evo.core`` is used, because the rest of evo writes a settings file into the home
directory when it is imported.

The figures equal those of evo's own commands run on the same two files::

    evo_ape tum GROUNDTRUTH ESTIMATE -a                                  ate.se3
    evo_ape tum GROUNDTRUTH ESTIMATE -as                                 ate.sim3
    evo_rpe tum GROUNDTRUTH ESTIMATE -r trans_part|angle_deg             rpe.per_frame
    evo_rpe ... --delta N --delta_unit f --all_pairs                     rpe.per_second

with ``N`` the frame rate rounded to whole frames, and ``--t_max_diff`` where
``max_difference_s`` is not the default.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


MAX_DIFFERENCE_S = 0.01
"""Poses farther apart in time than this are not compared; evo's own default."""

MIN_MATCHED_POSES = 3
"""Fewer positions than this do not determine an alignment."""


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error (ATE): distances between positions after alignment.

    Attributes:
        rmse_m, mean_m, median_m, max_m: over the matched poses, in metres of the ground truth.
        scale: factor on the estimate's lengths that the alignment found; 1 for SE(3).
        T_truth_estimate: ``(4, 4)`` alignment, its rotation part multiplied by ``scale``.
        errors_m: ``(N,)`` error of each matched pose.
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    scale: float
    T_truth_estimate: Floats
    errors_m: Floats


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error (RPE): drift of the motion over ``delta_frames`` matched poses.

    Attributes:
        delta_frames: distance of the two poses of a pair, counted in matched poses.
        trans_rmse_m, rot_rmse_deg: over all pairs.
        end_indices: ``(M,)`` index of each pair's later pose among the matched poses.
        trans_errors_m, rot_errors_deg: ``(M,)`` error of each pair.
    """

    delta_frames: int
    trans_rmse_m: float
    rot_rmse_deg: float
    end_indices: NDArray[np.int64]
    trans_errors_m: Floats
    rot_errors_deg: Floats


@dataclass(frozen=True)
class TrajectoryScore:
    """How far an estimate is from the ground truth.

    Attributes:
        matched: pairs of poses compared.
        estimate_poses, truth_poses: poses before matching.
        max_difference_s: largest time between two matched poses that was allowed.
        path_length_m: length of the ground truth along its matched poses.
        timestamps_s: ``(N,)`` times of the estimate's matched poses.
        truth_m, estimate_m: ``(N, 3)`` matched positions as given, not aligned.
        se3, sim3: ATE after alignment without and with scale.
        per_frame: RPE from each matched pose to the next.
        per_second: RPE over about one second, from every pose; None where the matched
            poses do not span a second.
    """

    matched: int
    estimate_poses: int
    truth_poses: int
    max_difference_s: float
    path_length_m: float
    timestamps_s: Floats
    truth_m: Floats
    estimate_m: Floats
    se3: AbsoluteError
    sim3: AbsoluteError
    per_frame: RelativeError
    per_second: RelativeError | None

    def to_dict(self) -> dict[str, Any]:
        """The figures as ``{"ate": ..., "rpe": ...}`` of numbers, None where unknown."""
        return {
            "ate": {
                "se3": _statistics(self.se3),
                "sim3": {**_statistics(self.sim3), "scale": self.sim3.scale},
                "matched_poses": self.matched,
                "estimate_poses": self.estimate_poses,
                "ground_truth_poses": self.truth_poses,
                "max_difference_s": self.max_difference_s,
                "path_length_m": self.path_length_m,
            },
            "rpe": {
                "per_frame": _relative_dict(self.per_frame),
                "per_second": _relative_dict(self.per_second),
            },
        }


def score_trajectory(
    ground_truth: Trajectory,
    estimate: Trajectory,
    *,
    max_difference_s: float = MAX_DIFFERENCE_S,
    fps: float | None = None,
) -> TrajectoryScore:
    """Compare ``estimate`` with ``ground_truth``; neither is changed.

    Poses are matched to the nearest in time, starting from the trajectory with fewer
    poses. Positions are aligned by least squares over all matched poses (Umeyama 1991).

    Args:
        max_difference_s: poses farther apart in time are not compared.
        fps: poses per second of the estimate, which set the span of ``per_second``;
            None takes the median spacing of the estimate's times.

    Raises:
        DatasetError: a pose is not finite, fewer than three poses match, or the matched
            positions do not determine an alignment (a camera that stood still or moved
            along a perfectly straight line).
    """
    from evo.core import sync
    from evo.core.geometry import GeometryException

    truth_full, estimate_full = _to_evo(ground_truth, "ground truth"), _to_evo(estimate, "estimate")
    hint = _overlap_hint(ground_truth, estimate)
    try:
        truth, matched = sync.associate_trajectories(truth_full, estimate_full, max_diff=max_difference_s)
    except sync.SyncException as error:
        raise DatasetError(
            f"no pose of the estimate lies within {max_difference_s:g} s of the ground truth{hint}"
        ) from error
    n = truth.num_poses
    if n < MIN_MATCHED_POSES:
        raise DatasetError(
            f"only {n} poses of the estimate lie within {max_difference_s:g} s of the ground truth, "
            f"scoring needs {MIN_MATCHED_POSES}{hint}"
        )
    try:
        se3 = _absolute_error(truth, matched, with_scale=False)
        sim3 = _absolute_error(truth, matched, with_scale=True)
    except GeometryException as error:
        raise DatasetError(
            f"the {n} matched positions do not determine an alignment: the ground truth or the estimate "
            "stands still or runs along a straight line, so no ATE can be given"
        ) from error

    delta = max(1, round(_poses_per_second(estimate) if fps is None else fps))
    return TrajectoryScore(
        matched=n,
        estimate_poses=len(estimate),
        truth_poses=len(ground_truth),
        max_difference_s=max_difference_s,
        path_length_m=float(truth.path_length),
        timestamps_s=np.array(matched.timestamps),
        truth_m=np.array(truth.positions_xyz),
        estimate_m=np.array(matched.positions_xyz),
        se3=se3,
        sim3=sim3,
        per_frame=_relative_error(truth, matched, delta=1),
        per_second=_relative_error(truth, matched, delta=delta) if n > delta else None,
    )


def _to_evo(trajectory: Trajectory, name: str) -> Any:
    """A copy as an evo trajectory."""
    from evo.core.trajectory import PoseTrajectory3D

    if len(trajectory) == 0:
        raise DatasetError(f"the {name} has no poses")
    poses = np.array(trajectory.T_world_camera, dtype=np.float64)
    times = np.array(trajectory.timestamps_s, dtype=np.float64)
    bad = ~(np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(times))
    if bad.any():
        raise DatasetError(
            f"the {name} has {int(bad.sum())} poses that are not finite, first at {bad.argmax()}"
        )
    R = poses[:, :3, :3]
    if not np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-6):
        raise DatasetError(f"the {name} has poses whose rotation is not orthonormal")
    return PoseTrajectory3D(poses_se3=list(poses), timestamps=times, name=name)


def _absolute_error(truth: Any, estimate: Any, *, with_scale: bool) -> AbsoluteError:
    from copy import deepcopy

    from evo.core import lie_algebra, metrics

    aligned = deepcopy(estimate)  # evo aligns in place
    R, t, scale = aligned.align(truth, correct_scale=with_scale)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((truth, aligned))
    statistic = metrics.StatisticsType
    return AbsoluteError(
        rmse_m=float(metric.get_statistic(statistic.rmse)),
        mean_m=float(metric.get_statistic(statistic.mean)),
        median_m=float(metric.get_statistic(statistic.median)),
        max_m=float(metric.get_statistic(statistic.max)),
        scale=float(scale),
        T_truth_estimate=np.asarray(lie_algebra.sim3(R, t, scale)),
        errors_m=np.asarray(metric.error),
    )


def _relative_error(truth: Any, estimate: Any, *, delta: int) -> RelativeError:
    from evo.core import metrics

    errors, ends = {}, []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        metric = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        metric.process_data((truth, estimate))
        errors[relation] = (np.asarray(metric.error), metric.get_statistic(metrics.StatisticsType.rmse))
        ends = metric.delta_ids
    trans = errors[metrics.PoseRelation.translation_part]
    rot = errors[metrics.PoseRelation.rotation_angle_deg]
    return RelativeError(
        delta_frames=delta,
        trans_rmse_m=float(trans[1]),
        rot_rmse_deg=float(rot[1]),
        end_indices=np.asarray(ends, dtype=np.int64),
        trans_errors_m=trans[0],
        rot_errors_deg=rot[0],
    )


def _poses_per_second(trajectory: Trajectory) -> float:
    """Rate from the median spacing of the times, which is robust to dropped frames."""
    spacing = float(np.median(np.diff(trajectory.timestamps_s))) if len(trajectory) > 1 else 0.0
    return 1.0 / spacing if spacing > 0 else 1.0


def _overlap_hint(ground_truth: Trajectory, estimate: Trajectory) -> str:
    a, b = ground_truth.timestamps_s, estimate.timestamps_s
    advice = "check that both belong to the same recording"
    spans = float(np.ptp(a)), float(np.ptp(b))
    if min(spans) > 0:
        ratio, offset_s = max(spans) / min(spans), float(abs(a[0] - b[0]))
        places = next((n for n in (3, 6, 9) if 0.5 < ratio / 10**n < 2.0), None)
        if places is not None:
            which = "ground truth" if spans[0] > spans[1] else "estimate"
            advice += f"; the times of the {which} span about 1e{places} times the other's: are both seconds?"
        elif offset_s > sum(spans):
            advice += f"; their clocks start {offset_s:.3f} s apart"
    return (
        f" (ground truth from {a[0]:.3f} to {a[-1]:.3f} s, estimate from {b[0]:.3f} to {b[-1]:.3f} s): "
        f"{advice}"
    )


def _statistics(error: AbsoluteError) -> dict[str, float]:
    return {
        "rmse_m": error.rmse_m,
        "mean_m": error.mean_m,
        "median_m": error.median_m,
        "max_m": error.max_m,
    }


def _relative_dict(error: RelativeError | None) -> dict[str, float | int | None]:
    return {
        "trans_rmse_m": error.trans_rmse_m if error else None,
        "rot_rmse_deg": error.rot_rmse_deg if error else None,
        "delta_frames": error.delta_frames if error else None,
    }
