# SPDX-License-Identifier: Apache-2.0
"""Rolling-shutter correction: pixels moved to where they would be at the time of the middle row.

Webcams, phones and the Kinect read an image row by row, the last row some 15 to 30 ms after
the first. Rotation distorts such an image: at 60 degrees a second and 25 ms its upper
and lower edges are off by 0.75 degrees, seven pixels of a 640 pixel wide image. Taken for a
rigid image, it shows spurious motion. The camera's velocity gives the correction of every
pixel (Ringaby and Forssén, "Efficient
Video Rectification and Stabilisation for Cell-Phones", IJCV 2012; here with translation).
"""

from __future__ import annotations

import numpy as np

from slamdepth.geometry import so3_log, transform
from slamdepth.types import Camera
from slamdepth.typing import Floats

_NEAREST_M = 0.05
_STEP_S = 1e-3  # of the difference quotient; the motion is linear in it but for the perspective


def row_phase(raw_px: Floats, camera: Camera) -> Floats:
    """When raw pixels ``(N, 2)`` are read out, ``(N,)``: -0.5 for the first row, 0.5 for the last.

    A sensor's rows run along its longer side, so in an upright image, such as a phone's, they are columns.
    """
    axis, rows = (1, camera.height) if camera.width >= camera.height else (0, camera.width)
    return np.asarray(raw_px[:, axis] / rows - 0.5, dtype=np.float64)


def velocity_between(T_camera_world_a: Floats, T_camera_world_b: Floats, interval_s: float) -> Floats:
    """Constant velocity between two poses.

    Args:
        T_camera_world_a, T_camera_world_b: ``(4, 4)``.
        interval_s: time from a to b.

    Returns:
        ``(6,)``: m/s and rad/s in the camera's own axes, equal for a and b to first order.
    """
    R_world_a, R_world_b = T_camera_world_a[:3, :3].T, T_camera_world_b[:3, :3].T
    turn = so3_log(R_world_a.T @ R_world_b)
    way_w = R_world_a @ T_camera_world_a[:3, 3] - R_world_b @ T_camera_world_b[:3, 3]
    way = 0.5 * (R_world_a.T + R_world_b.T) @ way_w
    return np.concatenate([way, turn]) / interval_s


def inverse_depth(T_camera_world: Floats, points_w: Floats) -> Floats:
    """Inverse depth ``(N,)`` in 1/m of points ``(N, 3)`` in a camera; points behind it count as near."""
    return np.asarray(1.0 / np.maximum(transform(T_camera_world, points_w)[:, 2], _NEAREST_M))


def at_middle_row(
    camera: Camera, px: Floats, phase: Floats, inverse_depth: Floats, velocity: Floats, readout_s: float
) -> Floats:
    """Pixels moved to where they would be at the time of the middle row, ``(N, 2)``.

    Args:
        camera: pinhole.
        px: ``(N, 2)`` undistorted pixels; phase: ``(N,)``, see :func:`row_phase`.
        inverse_depth: ``(N,)`` 1/m, 0 where only turning matters.
        velocity: ``(6,)``, see :func:`velocity_between`.
        readout_s: seconds from the first row to the last.
    """
    x = (px[:, 0] - camera.cx) / camera.fx
    y = (px[:, 1] - camera.cy) / camera.fy
    vx, vy, vz, wx, wy, wz = velocity
    dt = readout_s * phase
    # p + dt (omega x p + v), divided by the depth
    ahead = np.maximum(1.0 + dt * (wx * y - wy * x + vz * inverse_depth), 0.1)
    u = x + dt * (wy - wz * y + vx * inverse_depth)
    v = y + dt * (wz * x - wx + vy * inverse_depth)
    return np.column_stack([camera.fx * u / ahead + camera.cx, camera.fy * v / ahead + camera.cy])


def px_per_readout_s(
    camera: Camera, px: Floats, phase: Floats, inverse_depth: Floats, velocity: Floats
) -> Floats:
    """Derivative ``(N, 2)`` of :func:`at_middle_row` by the readout time, in pixels per second."""
    moved = at_middle_row(camera, px, phase, inverse_depth, velocity, _STEP_S)
    return np.asarray((moved - px) / _STEP_S, dtype=np.float64)
