# SPDX-License-Identifier: Apache-2.0
"""Scale and gravity of a camera's path from inertial data.

The rotations of the path and those of the gyroscope tell the time offset, the rotation between camera and
sensor and the gyroscope's bias. Then, as where visual-inertial systems start (Mur-Artal and Tardos 2017, Qin
et al. 2018), positions tell the scale. They are compared with the accelerometer integrated twice over windows
of a few seconds, each with a start and a velocity of its own:

    s p_c(t) + R_wc(t) p_cb = p_0 + v_0 t + int int R_wb (a - b_a) + g t^2 / 2

which is linear in scale ``s``, lever arm ``p_cb``, bias ``b_a`` and gravity ``g``, whose length is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.geometry import so3_log
from slamdepth.io.imu import ImuData
from slamdepth.scale.inertial_windows import (
    MAX_STEP_S,
    at_times,
    integral,
    jackknife,
    solve,
    windows_of,
)
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

_RATE_HZ = 100.0
_MIN_CORRELATION = 0.6
_RIVAL_S = 0.5  # another peak of the correlation this far away is another offset
_MAX_ROTATION_DEG = 3.0  # standard error of the rotation between camera and sensor
_FEWEST_WINDOWS = 4
_MAX_SIGMA_LOG = 0.2


@dataclass(frozen=True)
class InertialFit:
    """What inertial data say of a path.

    Attributes:
        scale: factor on the lengths of the path.
        sigma_log: standard error of the log of it, by the jackknife over windows.
        gravity_w: ``(3,)`` unit direction in the world of the path.
        R_camera_imu: ``(3, 3)``.
        offset_s: to be added to times of the path to give those of the sensor.
        gyro_bias, acc_bias: ``(3,)`` rad/s and m/s^2.
        windows: number of windows.
        is_reversed: True where the file has accelerations instead of specific forces, as on iOS.
    """

    scale: float
    sigma_log: float
    gravity_w: Floats
    R_camera_imu: Floats
    offset_s: float
    gyro_bias: Floats
    acc_bias: Floats
    windows: int
    is_reversed: bool = False


def align_inertial(trajectory: Trajectory, imu: ImuData) -> InertialFit:
    """Fit scale and gravity.

    Args:
        trajectory: every frame with a pose, in metres of the map.
        imu: of the same time; its clock may have another zero.

    Raises:
        DatasetError: the two do not overlap, do not turn alike, or the motion does not tell the scale.
    """
    motion = _turning(trajectory)
    offset_s = _coarse_offset(motion, imu)
    offset_s, R_camera_imu, gyro_bias = _rotation(motion, imu, offset_s)
    windows = windows_of(trajectory, imu, offset_s, R_camera_imu)
    if len(windows) < _FEWEST_WINDOWS:
        raise DatasetError("the camera was tracked together with inertial data for too short a time")
    fit = solve(windows)
    is_reversed = fit.scale < 0
    if is_reversed:
        windows = [replace(window, twice=-window.twice, of_bias=-window.of_bias) for window in windows]
        fit = solve(windows)
    sigma_log = jackknife(windows, fit.scale)
    if not (fit.scale > 0 and sigma_log <= _MAX_SIGMA_LOG):
        sure = f"{100 * sigma_log:.0f} %" if math.isfinite(sigma_log) else "any factor"
        raise DatasetError(
            f"the motion does not tell the scale (to {sure}): it takes changes of speed, such as moving the "
            "camera to and fro for some seconds"
        )
    gravity_w = fit.gravity / np.linalg.norm(fit.gravity)
    return InertialFit(
        fit.scale,
        sigma_log,
        gravity_w,
        R_camera_imu,
        offset_s,
        gyro_bias,
        fit.bias,
        len(windows),
        is_reversed,
    )


@dataclass(frozen=True)
class _Turning:
    """Angular velocities ``(N, 3)`` in the camera's frame between poses at ``start_s`` and ``end_s``."""

    start_s: Floats
    end_s: Floats
    rates: Floats


def _turning(trajectory: Trajectory) -> _Turning:
    times_s, R = trajectory.timestamps_s, trajectory.T_world_camera[:, :3, :3]
    step_s = np.diff(times_s)
    keep = step_s <= MAX_STEP_S
    if np.count_nonzero(keep) < 20:
        raise DatasetError("too few frames in a row have a pose to be compared with inertial data")
    turn = so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    return _Turning(times_s[:-1][keep], times_s[1:][keep], turn[keep] / step_s[keep, None])


def _mean_rates(imu: ImuData, start_s: Floats, end_s: Floats) -> Floats:
    """Mean angular velocity ``(N, 3)`` of the sensor over intervals, NaN beyond its data."""
    total = integral(imu.times_s, imu.rates)
    a, b = (at_times(imu.times_s, total, t) for t in (start_s, end_s))
    return np.asarray((b - a) / (end_s - start_s)[:, None])


def _coarse_offset(motion: _Turning, imu: ImuData) -> float:
    """The offset at which the angular speeds correlate best.

    Where both clocks agree already, offsets of up to a second are tried; else every one.
    """
    middle_s = (motion.start_s + motion.end_s) / 2
    frame_s = float(np.median(motion.end_s - motion.start_s))
    grid_s = np.arange(middle_s[0], middle_s[-1], 1 / _RATE_HZ)
    seen = np.interp(grid_s, middle_s, np.linalg.norm(motion.rates, axis=1))
    seen_s = float(grid_s[-1] - grid_s[0])
    is_one_clock = imu.times_s[0] <= grid_s[0] + 0.1 * seen_s and imu.times_s[-1] >= grid_s[-1] - 0.1 * seen_s
    if is_one_clock:
        lags_s = np.arange(-1.0, 1.0, 1 / _RATE_HZ)
    else:
        lags_s = np.arange(imu.times_s[0] - grid_s[0], imu.times_s[-1] - grid_s[-1], 1 / _RATE_HZ)
    if not len(lags_s):
        raise DatasetError("the inertial data cover a shorter time than the frames with a pose")
    times_s = np.arange(grid_s[0] + lags_s[0], grid_s[-1] + lags_s[-1] + 1 / _RATE_HZ, 1 / _RATE_HZ)
    felt = np.linalg.norm(_mean_rates(imu, times_s - frame_s / 2, times_s + frame_s / 2), axis=1)
    felt = np.nan_to_num(felt, nan=float(np.nanmean(felt)) if np.isfinite(felt).any() else 0.0)
    score = _correlation(felt, seen)
    best = int(np.argmax(score))
    elsewhere = np.abs(np.arange(len(score)) - best) > _RIVAL_S * _RATE_HZ
    rival = float(score[elsewhere].max()) if elsewhere.any() else 0.0
    if score[best] < _MIN_CORRELATION or rival > 0.5 * (1.0 + score[best]):
        raise DatasetError(
            f"camera and inertial sensor do not turn alike at any offset (correlation {score[best]:.2f}): "
            "the file may be of another recording, or the camera hardly turns"
        )
    return float(lags_s[0] + best / _RATE_HZ)


def _correlation(long: Floats, short: Floats) -> Floats:
    """Pearson correlation of ``short (M,)`` with each part of ``long (N,)``; ``(N - M + 1,)``."""
    from scipy.signal import fftconvolve

    count = len(short)
    if len(long) < count:
        return np.zeros(1)
    centred = short - short.mean()
    product = fftconvolve(long, centred[::-1], mode="valid")
    ones = np.ones(count)
    mean = fftconvolve(long, ones, mode="valid") / count
    variance = fftconvolve(long**2, ones, mode="valid") / count - mean**2
    norm = np.sqrt(np.maximum(variance, 1e-12) * max(float(centred @ centred), 1e-12) * count)
    return np.asarray(product / norm)


def _rotation(motion: _Turning, imu: ImuData, offset_s: float) -> tuple[float, Floats, Floats]:
    """Time offset, rotation from sensor to camera and gyroscope bias, from angular velocities."""
    from scipy.optimize import minimize_scalar

    def cost(shift_s: float) -> float:
        return _kabsch(motion, imu, offset_s + shift_s)[2]

    shifts_s = np.linspace(-0.05, 0.05, 21)
    start_s = float(shifts_s[int(np.argmin([cost(float(shift)) for shift in shifts_s]))])
    found = minimize_scalar(cost, bounds=(start_s - 0.006, start_s + 0.006), method="bounded")
    offset_s += float(found.x)
    R, bias, _, error_deg = _kabsch(motion, imu, offset_s)
    if error_deg > _MAX_ROTATION_DEG:
        raise DatasetError(
            f"the camera turns about one axis only, which leaves its rotation to the inertial sensor open "
            f"(to {min(error_deg, 180.0):.0f} degrees): turn it about two"
        )
    return offset_s, R, bias


def _kabsch(motion: _Turning, imu: ImuData, offset_s: float) -> tuple[Floats, Floats, float, float]:
    """Rotation, bias, mean squared residual and standard error of the rotation in degrees."""
    felt = _mean_rates(imu, motion.start_s + offset_s, motion.end_s + offset_s)
    both = np.isfinite(felt).all(axis=1)
    if np.count_nonzero(both) < 20:
        return np.eye(3), np.zeros(3), math.inf, math.inf
    felt, seen = felt[both], motion.rates[both]
    weight = np.ones(len(felt))
    for _ in range(5):  # poses that leap are outliers
        share = weight / weight.sum()
        mean_felt, mean_seen = share @ felt, share @ seen
        H = (seen - mean_seen).T @ ((felt - mean_felt) * share[:, None])
        U, _, Vt = np.linalg.svd(H)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        off = np.linalg.norm(seen - mean_seen - (felt - mean_felt) @ R.T, axis=1)
        spread = max(float(np.median(off)), 1e-9)
        weight = 1.0 / np.maximum(1.0, off / (2.0 * spread))
    spectrum = np.linalg.eigvalsh(np.cov((felt - mean_felt).T))
    sigma = spread / math.sqrt(3.0 * len(felt) * max(float(spectrum[1]), 1e-15))
    return (
        R,
        mean_felt - R.T @ mean_seen,
        float(np.mean(np.minimum(off, 4 * spread) ** 2)),
        math.degrees(sigma),
    )
