# SPDX-License-Identifier: Apache-2.0
"""Scale, gravity and the accelerometer's bias from positions, by least squares over windows of a few seconds.

See :mod:`slamdepth.scale.inertial` for the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slamdepth.io.imu import STANDARD_GRAVITY, ImuData
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

MAX_STEP_S = 0.5
"""Between poses that tell of the motion between them."""
_WINDOW_S = (1.0, 4.0)
_WINDOWS = 8
_LEVER_SIGMA_M = 0.1
_BIAS_SIGMA = 0.3  # m/s^2, of a phone's accelerometer


def integral(times_s: Floats, values: Floats) -> Floats:
    """Integral ``(N, ...)`` from the first time by the trapezoidal rule."""
    step = np.diff(times_s).reshape(-1, *([1] * (values.ndim - 1)))
    return np.concatenate(
        [np.zeros((1, *values.shape[1:])), np.cumsum((values[1:] + values[:-1]) / 2 * step, axis=0)]
    )


def at_times(times_s: Floats, values: Floats, wanted_s: Floats) -> Floats:
    """Values ``(N, 3)`` interpolated to ``wanted_s (M,)``; NaN outside."""
    columns = [np.interp(wanted_s, times_s, column, left=np.nan, right=np.nan) for column in values.T]
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Window:
    """Poses of some seconds, and what the accelerometer makes of them.

    Attributes:
        elapsed_s: ``(n,)`` since the first.
        places: ``(n, 3)`` in metres of the map.
        R_world_camera: ``(n, 3, 3)``.
        twice: ``(n, 3)`` specific force in the world, integrated twice.
        of_bias: ``(n, 3, 3)`` what a unit of bias adds to it.
    """

    elapsed_s: Floats
    places: Floats
    R_world_camera: Floats
    twice: Floats
    of_bias: Floats

    def rows(self, gravity: Floats) -> tuple[Floats, Floats]:
        """Coefficients ``(3 n, 9)`` of scale, lever arm, bias and gravity's two directions, and the rest.

        Start and velocity of the window are projected out.
        """
        t = self.elapsed_s
        basis = np.linalg.qr(np.column_stack([np.ones_like(t), t]))[0]
        tangent = np.linalg.svd(gravity[None, :])[2][1:].T * np.linalg.norm(gravity)
        fall = (t**2 / 2)[:, None, None]
        terms = np.concatenate(
            [self.places[:, :, None], self.R_world_camera, self.of_bias, -fall * tangent], axis=2
        )
        rest = self.twice + fall[:, :, 0] * gravity

        def free(values: Floats) -> Floats:
            flat = values.reshape(len(t), -1)
            return np.asarray((flat - basis @ (basis.T @ flat)).reshape(values.shape))

        return free(terms).reshape(-1, 9), free(rest).ravel()


def windows_of(trajectory: Trajectory, imu: ImuData, offset_s: float, R_camera_imu: Floats) -> list[Window]:
    times_s = trajectory.timestamps_s
    inside = (times_s + offset_s >= imu.times_s[0]) & (times_s + offset_s <= imu.times_s[-1])
    times_s, T = times_s[inside], trajectory.T_world_camera[inside]
    if len(times_s) < 20:
        return []
    length_s = float(np.clip((times_s[-1] - times_s[0]) / _WINDOWS, *_WINDOW_S))
    found = []
    breaks = np.flatnonzero(np.diff(times_s) > MAX_STEP_S) + 1
    for piece in np.split(np.arange(len(times_s)), breaks):
        span_s = times_s[piece[-1]] - times_s[piece[0]]
        count = max(1, math.floor(span_s / length_s))
        edges = np.linspace(times_s[piece[0]], times_s[piece[-1]], count + 1)
        for low, high in pairwise(edges):
            mine = piece[(times_s[piece] >= low) & (times_s[piece] <= high)]
            if len(mine) >= 8 and high - low >= 0.5 * length_s:
                found.append(_window(times_s[mine], T[mine], imu, offset_s, R_camera_imu))
    return found


def _window(
    times_s: Floats, T_world_camera: Floats, imu: ImuData, offset_s: float, R_camera_imu: Floats
) -> Window:
    from scipy.spatial.transform import Rotation, Slerp

    own_s = imu.times_s - offset_s
    between = own_s[(own_s > times_s[0]) & (own_s < times_s[-1])]
    fine_s = np.union1d(times_s, between)
    R = Slerp(times_s, Rotation.from_matrix(T_world_camera[:, :3, :3]))(fine_s).as_matrix() @ R_camera_imu
    force = np.einsum("nij,nj->ni", R, at_times(own_s, imu.forces, fine_s))
    at = np.searchsorted(fine_s, times_s)
    twice = integral(fine_s, integral(fine_s, force))[at]
    of_bias = integral(fine_s, integral(fine_s, R))[at]
    return Window(times_s - times_s[0], T_world_camera[:, :3, 3], T_world_camera[:, :3, :3], twice, of_bias)


@dataclass(frozen=True)
class Solution:
    """Scale, the accelerometer's bias ``(3,)`` in m/s^2 and gravity ``(3,)`` in the world."""

    scale: float
    bias: Floats
    gravity: Floats


def solve(windows: list[Window]) -> Solution:
    """Least squares with gravity of known length, and weak priors on lever arm and bias."""
    gravity = _first_gravity(windows)
    weights = np.ones(len(windows))
    x = np.zeros(9)
    sigma = 0.01
    for _ in range(8):
        rows = [window.rows(gravity) for window in windows]
        J = np.concatenate([w * J for w, (J, _) in zip(weights, rows, strict=True)])
        r = np.concatenate([w * r for w, (_, r) in zip(weights, rows, strict=True)])
        prior = np.diag([0.0, *[sigma / _LEVER_SIGMA_M] * 3, *[sigma / _BIAS_SIGMA] * 3, 0.0, 0.0])
        # where gravity turns too far at once, the step is held
        x = np.linalg.lstsq(np.concatenate([J, prior]), np.concatenate([r, np.zeros(9)]), rcond=None)[0]
        tangent = np.linalg.svd(gravity[None, :])[2][1:].T * np.linalg.norm(gravity)
        gravity = gravity + tangent @ np.clip(x[7:9], -0.5, 0.5)
        gravity *= STANDARD_GRAVITY / np.linalg.norm(gravity)
        rms = np.array([math.sqrt(float(np.mean((J @ x - r) ** 2))) for J, r in rows])
        sigma = max(float(np.median(rms)), 1e-5)
        weights = 1.0 / np.maximum(1.0, rms / (2.0 * sigma))
    return Solution(float(x[0]), x[4:7], gravity)


def _first_gravity(windows: list[Window]) -> Floats:
    """Against the mean specific force in the world, since accelerations average out."""
    force = [np.asarray(2 * w.twice[-1] / w.elapsed_s[-1] ** 2) for w in windows]
    mean = -np.median(force, axis=0)
    return np.asarray(mean * STANDARD_GRAVITY / max(float(np.linalg.norm(mean)), 1e-9))


def jackknife(windows: list[Window], scale: float) -> float:
    """Standard error of the log of the scale, from the scales without one window each (Tukey 1958)."""
    count = len(windows)
    without = [solve(windows[:k] + windows[k + 1 :]).scale for k in range(count)]
    if scale <= 0 or min(without) <= 0:
        return math.inf
    logs = np.log(without)
    return math.sqrt((count - 1) / count * float(np.sum((logs - logs.mean()) ** 2)))
