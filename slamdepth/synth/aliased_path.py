# SPDX-License-Identifier: Apache-2.0
"""The camera path of the aliased hall: along the workstations, and back to earlier ones."""

from __future__ import annotations

import numpy as np

from slamdepth.synth.aliased import Hall
from slamdepth.synth.path import hand_held
from slamdepth.typing import Floats

SPEED_M_S = 1.0
"""Speed of the camera between two turns, that of a person who walks."""

_BRAKE_S = 0.8  # to slow down before walking back, and to speed up after it
_ABOUT_FACE_S = 4.5  # to turn from the workstations to the doors behind the camera
_FACES_ABOUT_FROM_S = 12.0  # shorter paths look at the workstations all the time
_KEEPS_FACING = 0.25  # share of the turns after the first that do so, too
_LATE = 0.15  # share of its time by which a path may be too long: the camera then walks faster


def aliased_path_poses(phase: Floats, duration_s: float, seed: int) -> Floats:
    """Poses ``T_world_camera (N, 4, 4)`` at ``phase (N,)``, 0 to 1 along the closed path.

    The camera walks along the hall, turns back at random workstations, and ends where it began. It looks at
    the workstations, and after most turns at the doors on the other side, so that it sees workstations again
    for which it has lost track of the landmarks. The world is z up.

    Args:
        phase: where along the path.
        duration_s: how long the whole path takes; each second makes it about 0.8 m longer.
        seed: seed of the hall, of the turns, and of the hand's tremor.
    """
    hall = Hall.of(seed)
    rng = np.random.default_rng([seed, 10])
    phase = np.asarray(phase, dtype=np.float64)
    angle = 2.0 * np.pi * phase
    turns = _turns(rng, hall, duration_s)
    small = min(1.0, duration_s / 6.0)  # short paths sway less, not faster

    position = np.empty((len(phase), 3))
    position[:, 0] = _along(turns, phase)
    position[:, 1] = (hall.south_m + 3.0) / 2.0 + 0.15 * small * _sway(rng, angle, duration_s, 7.0)
    position[:, 2] = 1.45 + 0.06 * small * _sway(rng, angle, duration_s, 5.0)
    yaw = np.radians(90.0) + np.radians(12.0) * small * _sway(rng, angle, duration_s, 7.0)
    if duration_s >= _FACES_ABOUT_FROM_S:
        yaw = yaw - _faced_about(rng, turns, phase, duration_s)
    pitch = np.radians(-12.0) + np.radians(5.0) * small * _sway(rng, angle, duration_s, 6.0)
    return hand_held(rng, position, yaw, pitch, angle, duration_s)


def _sway(rng: np.random.Generator, angle: Floats, duration_s: float, period_s: float) -> Floats:
    """A wave of amplitude 1 and about ``period_s`` that closes with the path."""
    return np.sin(max(1, round(duration_s / period_s)) * angle + rng.uniform(0.0, 2.0 * np.pi))


def _faced_about(rng: np.random.Generator, turns: list[float], phase: Floats, duration_s: float) -> Floats:
    """How far the camera has turned clockwise at ``phase (N,)``, in radians; whole turns at the end."""
    _, ends = _leg_times(turns)
    share = _ABOUT_FACE_S / duration_s
    middles = [end for k, end in enumerate(ends[:-1]) if k == 0 or rng.random() >= _KEEPS_FACING]
    if len(middles) % 2:
        middles.append(1.0 - 0.5 * share)  # the last steps, so that the path closes
    total = np.zeros_like(phase)
    for middle in middles:
        start = min(max(middle - 0.5 * share, 0.0), 1.0 - share)
        total += np.pi * _eased(np.clip((phase - start) / share, 0.0, 1.0), np.full_like(phase, 0.25))
    return total


def _leg_s(distance_m: float) -> float:
    return abs(distance_m) / SPEED_M_S + (_BRAKE_S if distance_m else 0.0)


def _turns(rng: np.random.Generator, hall: Hall, duration_s: float) -> list[float]:
    """The x where the camera turns, the first and last being one; the way takes about ``duration_s``."""
    centres = hall.centres_m
    home = centres[int(rng.integers(0, hall.bays))]
    to_east = home < hall.length_m / 2
    turns, left_s = [home], duration_s
    while True:
        here = turns[-1]
        ahead = [x for x in centres if abs(x - here) > 0.1 and (x > here) == to_east]
        limit_s = left_s * (1 + _LATE)
        reach = [x for x in ahead if _leg_s(x - here) + _leg_s(home - x) <= limit_s]
        if not reach:
            break
        # Out by up to four workstations and back by up to three, but by two or more where there is time.
        reach = sorted(reach, key=lambda x: abs(x - here))[: 4 if len(turns) % 2 else 3]
        turns.append(reach[int(rng.integers(min(1, len(reach) - 1), len(reach)))])
        left_s -= _leg_s(turns[-1] - here)
        to_east = not to_east
    if len(turns) == 1:  # too short for one workstation: out and back by what there is time for
        step = SPEED_M_S * max(0.1 * duration_s, 0.5 * duration_s - _BRAKE_S)
        turns.append(home + step * (1 if to_east else -1))
    if turns[-1] != home:
        turns.append(home)
    return turns


def _leg_times(turns: list[float]) -> tuple[Floats, Floats]:
    """The seconds of each leg at full speed, and the phases at which they end."""
    times_s = np.array([_leg_s(leg) for leg in np.diff(turns)])
    return times_s, np.cumsum(times_s) / times_s.sum()


def _along(turns: list[float], phase: Floats) -> Floats:
    """The x at ``phase (N,)`` of a walk over ``turns`` that slows down at each."""
    legs = np.diff(turns)
    times_s, ends = _leg_times(turns)
    starts = np.concatenate([[0.0], ends[:-1]])
    leg = np.minimum(np.searchsorted(ends, phase, side="right"), len(legs) - 1)
    share = (phase - starts[leg]) / (ends - starts)[leg]
    x: Floats = np.asarray(turns)[leg] + legs[leg] * _eased(share, _BRAKE_S / times_s[leg])
    return x


def _eased(share: Floats, ramp: Floats) -> Floats:
    """From 0 to 1 at constant speed, but for a smooth start and end of ``ramp`` each."""
    ramp = np.minimum(ramp, 0.5)
    left = np.minimum(share, 1.0 - share)
    slow = 0.5 * left - ramp / (2.0 * np.pi) * np.sin(np.pi * np.minimum(left / ramp, 1.0))
    covered = np.where(left < ramp, slow, left - 0.5 * ramp) / (1.0 - ramp)
    return np.where(share <= 0.5, covered, 1.0 - covered)
