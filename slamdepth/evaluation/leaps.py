# SPDX-License-Identifier: Apache-2.0
"""Steps of a trajectory that no real camera is likely to have made."""

from __future__ import annotations

import numpy as np

from slamdepth.geometry import invert, so3_log, transform
from slamdepth.types import Trajectory
from slamdepth.typing import Bools, Floats, Ints

MAX_STEP_S = 0.25
"""Over a longer time a hand can start and stop, so that the steps before and after say nothing."""

_FASTER = 15.0  # than the median speed
_LEAST_STEP_RAD = 0.05  # about 3 degrees of image motion: less is jitter, however still the camera stands
_CONFIRMED = 0.25  # of a step's velocity, found again in the step before or after
_SAMPLES = 50  # cameras that the scene's distance is measured from
_FEWEST_POINTS = 10
_POINTS = 5000  # of the map, evenly chosen: the map of --odometry kiss-icp is a dense cloud


def scene_distance(trajectory: Trajectory, points_w: Floats) -> float | None:
    """Median depth of the map in front of the camera, in the unit of the map.

    Points within 45 degrees of the optical axis count, seen or not: it is an order of magnitude.

    Args:
        points_w: ``(P, 3)`` map points, world frame.

    Returns:
        The median over cameras along the path; None where no camera has ten points in front of it.
    """
    count = len(trajectory)
    points_w = points_w[:: max(1, len(points_w) // _POINTS)]
    depths: list[float] = []
    for n in np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).round().astype(int)):
        x, y, z = transform(invert(trajectory.T_world_camera[n]), points_w).T
        in_front = z[(z > 0) & (np.abs(x) < z) & (np.abs(y) < z)]
        if len(in_front) >= _FEWEST_POINTS:
            depths.append(float(np.median(in_front)))
    return float(np.median(depths)) if depths else None


def judged_steps(trajectory: Trajectory) -> Bools:
    """``(N - 1,)``: whether a step is short enough in time to be compared with its neighbours."""
    judged: Bools = np.diff(trajectory.timestamps_s) <= MAX_STEP_S
    return judged


def find_leaps(trajectory: Trajectory, distance: float | None) -> Ints:
    """Indices of the steps that the motion around them contradicts; step ``n`` leads to pose ``n + 1``.

    Rotation and translation are compared in one unit, the image motion they cause: an angle, and a length
    over the distance of the scene. A leap is a step of

    * more than 15 times the median speed: the quickest turn of the recordings looked at has 5 times;
    * more than 3 degrees: before a camera that stands still the median speed is close to 0;
    * which neither the step before nor the step after confirms by a quarter of its velocity in its direction:
      a camera has mass, so a real quick turn takes several frames.

    Steps over more than 0.25 s (footage at a few frames a second, gaps of lost frames) are not judged, nor
    are steps without a judged neighbour. A cut in the recording looks the same as a leap.

    Args:
        distance: of the scene, see :func:`scene_distance`; None compares rotations only.
    """
    judged = judged_steps(trajectory)
    if not judged.any():
        return np.zeros(0, dtype=np.int64)
    velocity = _image_velocity(trajectory, distance)
    duration_s = np.diff(trajectory.timestamps_s)
    speed = np.linalg.norm(velocity, axis=1)
    is_fast = speed > _FASTER * np.median(speed[judged])
    is_far = speed * duration_s > _LEAST_STEP_RAD
    candidates = np.flatnonzero(judged & is_fast & is_far)
    return candidates[[_is_contradicted(velocity, judged, int(n)) for n in candidates]]


def _image_velocity(trajectory: Trajectory, distance: float | None) -> Floats:
    """``(N - 1, 6)`` angular velocity and velocity over the scene's distance, world frame, rad/s."""
    T = trajectory.T_world_camera
    R_step = T[1:, :3, :3] @ T[:-1, :3, :3].transpose(0, 2, 1)
    turn = so3_log(R_step)
    shift = np.diff(T[:, :3, 3], axis=0) / (np.inf if distance is None else distance)
    velocity: Floats = np.hstack([turn, shift]) / np.diff(trajectory.timestamps_s)[:, None]
    return velocity


def _is_contradicted(velocity: Floats, judged: Bools, n: int) -> bool:
    neighbours = [m for m in (n - 1, n + 1) if 0 <= m < len(judged) and judged[m]]
    along = [float(velocity[m] @ velocity[n]) for m in neighbours]
    return bool(along) and max(along) < _CONFIRMED * float(velocity[n] @ velocity[n])
