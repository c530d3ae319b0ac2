# SPDX-License-Identifier: Apache-2.0
"""The camera path of the synthetic sequence: hand-held, smooth, and closed."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

SPEED_M_S = 0.3
"""Mean speed of the camera, that of a walking person."""

_CENTRE_M = np.array([2.5, 2.0, 1.45])
_REACH_M = np.array([0.95, 0.75])
_LONG_LAP_S = 16.0


def path_poses(phase: Floats, duration_s: float, seed: int) -> Floats:
    """Poses ``T_world_camera (N, 4, 4)`` at ``phase (N,)``, 0 to 1 along the closed path.

    Phases 0 and 1 are the same viewpoint. A path of at least 16 s makes one or more full laps around the
    room. A shorter one sweeps to one side and returns another way, so that the camera never rotates faster
    than a hand-held one. The world is z up.

    Args:
        phase: where along the path.
        duration_s: how long the whole path takes.
        seed: seed of the hand's tremor and of the start.
    """
    rng = np.random.default_rng([seed, 1])
    phase = np.asarray(phase, dtype=np.float64)
    angle = 2.0 * np.pi * phase
    is_long = duration_s >= _LONG_LAP_S
    laps = max(1, round(duration_s / 20.0)) if is_long else 1
    length_m = SPEED_M_S * duration_s / laps
    radius = np.minimum(length_m / (2.0 * np.pi), _REACH_M)
    start = 0.9 + 0.5 * rng.random()
    turn = laps * angle + start

    position = np.empty((len(phase), 3))
    # On the far side of the centre, looking across the room.
    position[:, 0] = _CENTRE_M[0] - radius[0] * np.cos(turn)
    position[:, 1] = _CENTRE_M[1] - radius[1] * np.sin(turn)
    small = min(1.0, duration_s / 9.0)  # short paths move less, not faster
    position[:, 2] = _CENTRE_M[2] + small * (
        0.12 * np.sin(angle * laps + 0.4) + 0.04 * np.sin(2 * angle + 1.0)
    )

    if is_long:
        yaw = turn + 0.25 * np.sin(2 * angle)
    else:
        # A sweep of peak rate below 25 deg/s, whatever the duration.
        amplitude = min(np.radians(105.0), np.radians(25.0) * duration_s / (2.0 * np.pi) * 2.0) / 2.0
        yaw = start + amplitude * (1.0 - np.cos(angle))
    pitch = np.radians(-14.0) + np.radians(7.0) * np.sin(angle + 0.6) * small
    return hand_held(rng, position, yaw, pitch, angle, duration_s)


def hand_held(
    rng: np.random.Generator, position: Floats, yaw: Floats, pitch: Floats, angle: Floats, duration_s: float
) -> Floats:
    """Poses ``T_world_camera (N, 4, 4)`` of a camera in a trembling hand.

    The tremor is a sum of whole harmonics of the path, of about 0.5 to 1.5 Hz, so a closed path stays closed.

    Args:
        position: ``(N, 3)`` metres, z up; not changed.
        yaw, pitch: ``(N,)`` radians, about z from x, and up.
        angle: ``(N,)`` where along the path, 0 to 2 pi.
        duration_s: how long the whole path takes.
    """
    position, roll = position.copy(), np.zeros_like(angle)
    for axis, (size_m, size_rad) in enumerate([(0.004, 0.004), (0.004, 0.005), (0.005, 0.004)]):
        position[:, axis] += _tremor(rng, angle, duration_s, size_m)
        wobble = _tremor(rng, angle, duration_s, size_rad)
        if axis == 0:
            yaw = yaw + wobble
        elif axis == 1:
            pitch = pitch + wobble
        else:
            roll = roll + 2.0 * wobble
    return look(position, yaw, pitch, roll)


def _tremor(rng: np.random.Generator, angle: Floats, duration_s: float, size: float) -> Floats:
    total = np.zeros_like(angle)
    for frequency_hz in (0.5, 0.9, 1.4):
        harmonic = max(1, round(frequency_hz * duration_s * rng.uniform(0.85, 1.15)))
        total += size * 0.5 / frequency_hz * np.sin(harmonic * angle + rng.uniform(0.0, 2.0 * np.pi))
    return total


def look(position: Floats, yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """Poses of cameras at ``position`` looking along yaw (about z, from x) and pitch (up)."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    forward = np.stack([cy * cp, sy * cp, sp], axis=1)
    right0 = np.stack([sy, -cy, np.zeros_like(yaw)], axis=1)
    down0 = np.cross(forward, right0)
    cr, sr = np.cos(roll)[:, None], np.sin(roll)[:, None]
    T = np.zeros((len(yaw), 4, 4))
    T[:, :3, 0] = cr * right0 + sr * down0
    T[:, :3, 1] = -sr * right0 + cr * down0
    T[:, :3, 2] = forward
    T[:, :3, 3] = position
    T[:, 3, 3] = 1.0
    return T
