# SPDX-License-Identifier: Apache-2.0
"""Steps of a trajectory that no real camera is likely to have made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.geometry import invert, so3_log, transform
from slamdepth.types import Trajectory
from slamdepth.typing import Bools, Floats, Ints

MAX_STEP_S = 0.25
"""Over a longer time a hand can start and stop, so that the steps before and after say nothing."""

_FASTER = 15.0  # than the median speed
_LEAST_STEP_RAD = 0.05  # about 3 degrees of image motion: less is jitter, however still the camera stands
_CONFIRMED = 0.25  # of a step's velocity, found again in the step before or after
_SURE = 0.1  # quality: below, the matches of a pose hardly determine it
_GOOD = 0.5
_SAMPLES = 50  # cameras that the scene's distance is measured from
_FEWEST_POINTS = 10
_CONFIRM_S = 1.0  # a hand that is pushed keeps on for less
_FEWEST_IN_MOTION = 3  # poses: with two there is one step, and nothing to compare it with
_GAP_STEPS = 3.0  # median steps in time: what is longer is a gap, however few frames a second there are
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


def find_leaps(trajectory: Trajectory, distance: float | None, quality: Floats | None = None) -> Ints:
    """Indices of the steps that the motion around them contradicts; step ``n`` leads to pose ``n + 1``.

    Rotation and translation are compared in one unit, the image motion they cause: an angle, and a length
    over the distance of the scene. A leap is a step of

    * more than 15 times the median speed, or of the camera's centre alone: the quickest turn of the
      recordings looked at has 5 times;
    * more than 3 degrees: before a camera that stands still the median speed is close to 0;
    * which neither the step before nor the step after confirms by a quarter of its velocity in its direction:
      a camera has mass, so a real quick turn takes several frames.

    Steps over more than 0.25 s (footage at a few frames a second, gaps of lost frames) are not judged, nor
    are steps without a judged neighbour. A pose that repeats the one before (:func:`repeated_poses`) is left
    out: the step over it has the motion of both intervals. A cut in the recording looks the same as a leap.

    Args:
        distance: of the scene, see :func:`scene_distance`; None compares rotations only.
        quality: ``(N,)`` of the poses, see :class:`slamdepth.StepResult`: a step to or from a pose that its
            own matches hardly determine confirms nothing. None: all do.
    """
    if not judged_steps(trajectory).any():
        return np.zeros(0, dtype=np.int64)
    speed = np.linalg.norm(_image_velocity(trajectory, distance), axis=1)
    kept = np.flatnonzero(~repeated_poses(speed, np.diff(trajectory.timestamps_s)))
    moving = Trajectory(trajectory.timestamps_s[kept], trajectory.T_world_camera[kept])
    found = _leaps(moving, distance, None if quality is None else quality[kept])
    return np.asarray(kept[found + 1] - 1)


def repeated_poses(speed: Floats, duration_s: Floats) -> Bools:
    """Poses that repeat the one before, as webcams and converters repeat an image that comes too late.

    Such a pose has no motion of its own, and the step after it has that of two intervals: together they are
    one step. Never two in a row, for a camera that stands still repeats its pose, too.

    Args:
        speed: ``(N - 1,)`` of the steps, in any unit.
        duration_s: ``(N - 1,)`` of them.

    Returns:
        ``(N,)``, True for pose ``n + 1`` where step ``n`` is slower than a fifteenth of the median, and takes
        at most 0.25 s together with the next one.
    """
    repeated = np.zeros(len(speed) + 1, dtype=np.bool_)
    judged = duration_s <= MAX_STEP_S
    if not judged.any():
        return repeated
    rests = speed * _FASTER < np.median(speed[judged])
    rests[:-1] &= duration_s[:-1] + duration_s[1:] <= MAX_STEP_S
    rests[-1] = False
    for n in np.flatnonzero(rests):
        repeated[n + 1] = not repeated[n]
    return repeated


def _leaps(trajectory: Trajectory, distance: float | None, quality: Floats | None) -> Ints:
    """See :func:`find_leaps`; no pose repeats another."""
    judged = judged_steps(trajectory)
    velocity = _image_velocity(trajectory, distance)
    duration_s = np.diff(trajectory.timestamps_s)
    speed = np.linalg.norm(velocity, axis=1)
    centre_m_s = np.linalg.norm(np.diff(trajectory.T_world_camera[:, :3, 3], axis=0), axis=1) / duration_s
    is_fast = speed > _FASTER * np.median(speed[judged])
    is_fast |= centre_m_s > _FASTER * np.median(centre_m_s[judged])
    is_far = speed * duration_s > _LEAST_STEP_RAD
    candidates = np.flatnonzero(judged & is_fast & is_far)
    confirms = judged if quality is None else judged & (np.minimum(quality[:-1], quality[1:]) >= _SURE)
    return candidates[[_is_contradicted(velocity, judged, confirms, int(n)) for n in candidates]]


def unconfirmed_poses(
    trajectory: Trajectory,
    distance: float | None,
    quality: Floats | None = None,
    led: Bools | None = None,
) -> Bools:
    """Poses of short pieces that only leaps join to the rest, or that stand alone: no motion confirms them.

    One or two poses stand alone where a gap of over 0.25 s and three usual steps, or an end of the
    trajectory, is before and behind them. Leaps (:func:`find_leaps`) and gaps of over 0.25 s cut a trajectory
    into pieces. A piece of less than a second that begins or ends with a leap is unconfirmed: a single pose
    that leaps there and back, or the first poses of a map before it found itself. One between a leap and a
    gap is kept where most of its poses are good by themselves and no motion led over the leap: after a cut.
    The search is repeated without them, as they hid what the motion around them is. The longest piece is
    always kept, and so is everything of a trajectory without leaps and gaps.

    Args:
        distance: of the scene, see :func:`scene_distance`; None compares rotations only.
        quality: ``(N,)`` of the poses, see :func:`find_leaps`.
        led: ``(N,)``, whether a pose was looked for where the motion before led. None: none was.

    Returns:
        ``(N,)``, True where a pose is unconfirmed.
    """
    kept = np.arange(len(trajectory))
    while len(kept) > 1:
        rest = Trajectory(trajectory.timestamps_s[kept], trajectory.T_world_camera[kept])
        sure = None if quality is None else quality[kept]
        leaps = find_leaps(rest, distance, sure)
        was_led = np.zeros(len(kept), dtype=np.bool_) if led is None else led[kept]
        short = _short_pieces(rest, leaps, sure, was_led)
        if not short.any():
            break
        kept = kept[~short]
    unconfirmed = np.ones(len(trajectory), dtype=bool)
    unconfirmed[kept] = False
    return unconfirmed


def confirmed(
    trajectory: Trajectory, points_w: Floats, quality: Floats | None = None, led: Bools | None = None
) -> Trajectory:
    """The trajectory without its :func:`unconfirmed_poses`; itself where there are none.

    Args:
        points_w: ``(P, 3)`` map points, world frame.
        quality, led: ``(N,)`` of the poses, see :func:`unconfirmed_poses`.
    """
    drop = unconfirmed_poses(trajectory, scene_distance(trajectory, points_w), quality, led)
    if not drop.any():
        return trajectory
    return replace(
        trajectory,
        timestamps_s=trajectory.timestamps_s[~drop],
        T_world_camera=trajectory.T_world_camera[~drop],
    )


def _short_pieces(trajectory: Trajectory, leaps: Ints, quality: Floats | None, led: Bools) -> Bools:
    """``(N,)`` whether a pose is in a piece of less than a second with a leap at an end, or stands alone.

    The longest piece is in none, nor is one between a leap that no motion led over and a gap whose poses are
    good by themselves, as after a cut.
    """
    is_leap = np.zeros(len(trajectory) + 1, dtype=bool)  # at n: between poses n - 1 and n
    is_leap[leaps + 1] = True
    is_cut = is_leap.copy()
    is_cut[1:-1] |= ~judged_steps(trajectory)
    is_cut[[0, -1]] = True
    steps_s = np.diff(trajectory.timestamps_s)
    is_gap = np.ones(len(is_cut), dtype=bool)
    is_gap[1:-1] = steps_s > max(MAX_STEP_S, _GAP_STEPS * float(np.median(steps_s)))
    ends = np.flatnonzero(is_cut)
    first, end = ends[:-1], ends[1:]
    lasts_s = trajectory.timestamps_s[end - 1] - trajectory.timestamps_s[first]
    is_short = (lasts_s < _CONFIRM_S) & (is_leap[first] | is_leap[end])
    longest = np.argmax(lasts_s)
    if quality is not None:
        is_good = [float(np.median(quality[a:b])) >= _GOOD for a, b in zip(first, end, strict=True)]
        is_led = np.zeros_like(is_leap)
        is_led[leaps + 1] = led[leaps + 1]
        after_cut = np.array(is_good) & ~(is_leap[first] & is_leap[end]) & ~(is_led[first] | is_led[end])
        is_short &= ~after_cut
    is_short |= (end - first < _FEWEST_IN_MOTION) & is_gap[first] & is_gap[end]
    is_short[longest] = False
    return np.repeat(is_short, end - first)


def _image_velocity(trajectory: Trajectory, distance: float | None) -> Floats:
    """``(N - 1, 6)`` angular velocity and velocity over the scene's distance, world frame, rad/s."""
    T = trajectory.T_world_camera
    R_step = T[1:, :3, :3] @ T[:-1, :3, :3].transpose(0, 2, 1)
    turn = so3_log(R_step)
    shift = np.diff(T[:, :3, 3], axis=0) / (np.inf if distance is None else distance)
    velocity: Floats = np.hstack([turn, shift]) / np.diff(trajectory.timestamps_s)[:, None]
    return velocity


def _is_contradicted(velocity: Floats, judged: Bools, confirms: Bools, n: int) -> bool:
    neighbours = [m for m in (n - 1, n + 1) if 0 <= m < len(judged) and judged[m]]
    along = [float(velocity[m] @ velocity[n]) if confirms[m] else 0.0 for m in neighbours]
    return bool(along) and max(along) < _CONFIRMED * float(velocity[n] @ velocity[n])
