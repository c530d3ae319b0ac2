# SPDX-License-Identifier: Apache-2.0
"""Alignment of a reconstruction by all of its poses, their orientations included.

The usual alignment of trajectories (Umeyama 1991) looks at positions only. Over a path that is short for what
the camera sees, it turns the reconstruction by degrees: positions that err by 2 cm over 0.5 m turn a wall at
2 m by 8 cm. Orientations settle the rotation far better (Salas et al., "Trajectory alignment and evaluation
in SLAM: Horn's method vs alignment on the manifold", 2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.geometry import invert, se3_exp, se3_log
from slamdepth.types import Trajectory
from slamdepth.typing import Floats, Ints

_LEAST_POSES = 3
_LEAST_SPREAD_M = 1e-4


@dataclass(frozen=True)
class PoseAlignment:
    """What brings a reconstruction into the world of the ground truth.

    Attributes:
        se3, sim3: ``T_truth_estimate (4, 4)``; the rotation part of ``sim3`` is multiplied by ``scale``.
        scale: true metres that one of the reconstruction is.
    """

    se3: Floats
    sim3: Floats
    scale: float


def align_by_poses(ground_truth: Trajectory, estimate: Trajectory, max_difference_s: float) -> PoseAlignment:
    """Align ``estimate`` with ``ground_truth``.

    The rotation is the chordal mean of those between true and estimated orientations (Hartley et al.,
    "Rotation averaging", 2013); translation and scale are the least squares of the positions, given it.

    Args:
        max_difference_s: estimated poses farther in time from every true one are left out.

    Raises:
        DatasetError: fewer than three poses have a true one, or the camera stood still.
    """
    rows, T_truth = poses_at(ground_truth, estimate.timestamps_s, max_difference_s)
    if len(rows) < _LEAST_POSES:
        raise DatasetError(
            f"only {len(rows)} poses of the estimate have a ground truth within {max_difference_s:g} s, "
            f"alignment needs {_LEAST_POSES}"
        )
    T_estimate = estimate.T_world_camera[rows]
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", T_truth[:, :3, :3], T_estimate[:, :3, :3]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    truth, turned = T_truth[:, :3, 3], T_estimate[:, :3, 3] @ R.T
    d_truth, d_turned = truth - truth.mean(axis=0), turned - turned.mean(axis=0)
    spread = float((d_turned * d_turned).sum())
    scale = float((d_truth * d_turned).sum()) / spread if spread > 0 else 0.0
    if spread < len(rows) * _LEAST_SPREAD_M**2 or scale <= 0:
        raise DatasetError(
            "the camera stands still, or moves against the ground truth: no scale can be found"
        )
    return PoseAlignment(_similarity(1.0, R, truth, turned), _similarity(scale, R, truth, turned), scale)


def _similarity(scale: float, R: Floats, truth: Floats, turned: Floats) -> Floats:
    T: Floats = np.eye(4)
    T[:3, :3] = scale * R
    T[:3, 3] = truth.mean(axis=0) - scale * turned.mean(axis=0)
    return T


def poses_at(trajectory: Trajectory, times_s: Floats, max_difference_s: float) -> tuple[Ints, Floats]:
    """Poses of a trajectory at ``times_s (N,)``, interpolated on SE(3) between the two around each time.

    Returns:
        The indices ``(K,)`` of the times that have a pose at most ``max_difference_s`` away, and the
        ``(K, 4, 4)`` poses.
    """
    known_s, T = trajectory.timestamps_s, trajectory.T_world_camera
    after = np.clip(np.searchsorted(known_s, times_s), 1, max(1, len(known_s) - 1))
    before = after - 1
    after = np.minimum(after, len(known_s) - 1)
    gap = np.maximum(known_s[after] - known_s[before], 1e-9)
    share = np.clip((times_s - known_s[before]) / gap, 0.0, 1.0)
    near = np.minimum(np.abs(times_s - known_s[before]), np.abs(known_s[after] - times_s))
    found = np.flatnonzero(near <= max_difference_s)
    poses = np.empty((len(found), 4, 4))
    for row, k in enumerate(found.tolist()):
        motion = se3_log(invert(T[before[k]]) @ T[after[k]])
        poses[row] = T[before[k]] @ se3_exp(share[k] * motion)
    return found, poses
