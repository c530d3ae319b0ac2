# SPDX-License-Identifier: Apache-2.0
"""Refinement of a pose, compiled; the twins in NumPy are in :mod:`slamdepth.frontend.pose`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.frontend.compiled.jit import compiled, inlined
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

_Intrinsics = tuple[float, float, float, float]


@inlined
def _in_camera(T: Floats, p: Floats) -> tuple[float, float, float]:
    """A point ``p (3,)`` in the frame of a camera."""
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    return x, y, z


@inlined
def _symmetrise(H: Floats) -> None:
    """Copy the lower triangle of ``H (6, 6)`` to the upper one."""
    for m in range(6):
        for n in range(m):
            H[n, m] = H[m, n]


@inlined
def _whiten(
    T: Floats,
    points_w: Floats,
    covariance_w: Floats,
    sigma_px: Floats,
    lens: _Intrinsics,
    nearest: float,
    W: Floats,
) -> None:
    """Elements 00, 10 and 11 of the lower triangular W with W S W^T = 1, into ``W (N, 3)``."""
    fx, fy = lens[0], lens[1]
    for i in range(len(points_w)):
        p = points_w[i]
        x, y, z = _in_camera(T, p)
        z = max(z, nearest)
        su, sv = fx / z, fy / z
        u0, v0 = su * (T[0, 0] - x / z * T[2, 0]), sv * (T[1, 0] - y / z * T[2, 0])
        u1, v1 = su * (T[0, 1] - x / z * T[2, 1]), sv * (T[1, 1] - y / z * T[2, 1])
        u2, v2 = su * (T[0, 2] - x / z * T[2, 2]), sv * (T[1, 2] - y / z * T[2, 2])
        C = covariance_w[i]
        cu0 = C[0, 0] * u0 + C[0, 1] * u1 + C[0, 2] * u2
        cu1 = C[1, 0] * u0 + C[1, 1] * u1 + C[1, 2] * u2
        cu2 = C[2, 0] * u0 + C[2, 1] * u1 + C[2, 2] * u2
        cv0 = C[0, 0] * v0 + C[0, 1] * v1 + C[0, 2] * v2
        cv1 = C[1, 0] * v0 + C[1, 1] * v1 + C[1, 2] * v2
        cv2 = C[2, 0] * v0 + C[2, 1] * v1 + C[2, 2] * v2
        noise = sigma_px[i] * sigma_px[i]
        S00 = u0 * cu0 + u1 * cu1 + u2 * cu2 + noise
        S01 = u0 * cv0 + u1 * cv1 + u2 * cv2
        S11 = v0 * cv0 + v1 * cv1 + v2 * cv2 + noise
        a = 1.0 / math.sqrt(S00)
        b = S01 * a
        c = 1.0 / math.sqrt(max(S11 - b * b, 1e-12))
        W[i, 0], W[i, 1], W[i, 2] = a, -b * a * c, c


@inlined
def _row(
    T: Floats, p: Floats, px: Floats, W: Floats, lens: _Intrinsics, nearest: float, J: Floats
) -> tuple[float, float]:
    """Whitened residual of one match; its derivatives by the left perturbation into ``J (2, 6)``."""
    fx, fy, cx, cy = lens
    x, y, z = _in_camera(T, p)
    z = max(z, nearest)
    du, dv = fx * x / z + (cx - px[0]), fy * y / z + (cy - px[1])
    a, b, c = W[0], W[1], W[2]
    right0, right1, down = a * fx / z, b * fx / z, c * fy / z
    forward0 = -right0 * x / z
    forward1 = -right1 * x / z - down * y / z
    J[0, 0], J[0, 1], J[0, 2] = right0, 0.0, forward0
    J[1, 0], J[1, 1], J[1, 2] = right1, down, forward1
    # d(omega x p)/d omega = -[p]_x
    J[0, 3], J[0, 4], J[0, 5] = forward0 * y, right0 * z - forward0 * x, -right0 * y
    J[1, 3], J[1, 4], J[1, 5] = forward1 * y - down * z, right1 * z - forward1 * x, down * x - right1 * y
    return a * du, c * dv + b * du


@inlined
def _accumulate(
    T: Floats,
    points_w: Floats,
    px: Floats,
    W: Floats,
    used: NDArray[np.bool_],
    lens: _Intrinsics,
    nearest: float,
    huber: float,
    H: Floats,
    g: Floats,
) -> None:
    """Normal equations of the matches that are used; least squares where ``huber`` is 0."""
    J = np.empty((2, 6))
    H[:] = 0.0
    g[:] = 0.0
    for i in range(len(points_w)):
        if not used[i]:
            continue
        ru, rv = _row(T, points_w[i], px[i], W[i], lens, nearest, J)
        weight = 1.0
        if huber > 0.0:
            weight = huber / max(math.sqrt(ru * ru + rv * rv), huber)
        for m in range(6):
            wu, wv = weight * J[0, m], weight * J[1, m]
            g[m] += wu * ru + wv * rv
            for n in range(m + 1):
                H[m, n] += wu * J[0, n] + wv * J[1, n]
    _symmetrise(H)


@inlined
def _solve(H: Floats, g: Floats, step: Floats) -> bool:
    """``step = -(H + e)^-1 g`` by Cholesky, with a little damping; False where H is not positive definite."""
    trace = 0.0
    for m in range(6):
        trace += H[m, m]
    L = np.zeros((6, 6))
    for m in range(6):
        for n in range(m + 1):
            value = H[m, n] + (1e-9 * trace if m == n else 0.0)
            for k in range(n):
                value -= L[m, k] * L[n, k]
            if m > n:
                L[m, n] = value / L[n, n]
            elif value > 0.0:
                L[m, m] = math.sqrt(value)
            else:
                return False
    for m in range(6):
        value = g[m]
        for k in range(m):
            value -= L[m, k] * step[k]
        step[m] = value / L[m, m]
    for m in range(5, -1, -1):
        value = step[m]
        for k in range(m + 1, 6):
            value -= L[k, m] * step[k]
        step[m] = value / L[m, m]
    for m in range(6):
        step[m] = -step[m]
    return True


@inlined
def _moved(T: Floats, step: Floats) -> Floats:
    """``exp(step) @ T``, see :func:`slamdepth.geometry.se3_exp`."""
    x, y, z = step[3], step[4], step[5]
    theta2 = x * x + y * y + z * z
    a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    if theta2 >= 1e-12:
        theta = math.sqrt(theta2)
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    moved = np.zeros((4, 4))
    for m in range(3):
        for n in range(4):
            moved[m, n] = R[m, 0] * T[0, n] + R[m, 1] * T[1, n] + R[m, 2] * T[2, n]
        moved[m, 3] += step[m]
    moved[3, 3] = 1.0
    return moved


@compiled
def refine(
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
    lens: _Intrinsics,
    rounds: int,
    iterations: int,
    gate: float,
    huber: float,
    nearest_m: float,
    converged: tuple[float, float],
    rewhiten: float,
) -> tuple[bool, Floats, NDArray[np.bool_], Floats]:
    """Robust Gauss-Newton on the reprojection error, see :func:`slamdepth.frontend.pose.refine_pose`.

    Args:
        lens: fx, fy, cx, cy.
        converged: largest step that ends the iterations of a round, of the last and of the others.
        rewhiten: largest change of the pose that leaves the covariances in the image alike.

    Returns:
        Whether all systems could be solved, pose ``(4, 4)``, inliers ``(N,)`` and information ``(6, 6)``.
    """
    count = len(points_w)
    T = T_camera_world.copy()
    T_whitened = T
    W = np.empty((count, 3))
    _whiten(T, points_w, covariance_w, sigma_px, lens, nearest_m, W)
    active = np.ones(count, np.bool_)
    used = np.empty(count, np.bool_)
    H = np.eye(6) * 1e-6
    g, step, J = np.empty(6), np.empty(6), np.empty((2, 6))
    for round_ in range(rounds):
        is_last = round_ == rounds - 1
        limit = converged[0] if is_last else converged[1]
        usable = 0
        for i in range(count):
            p = points_w[i]
            z = _in_camera(T, p)[2]
            used[i] = active[i] and z > nearest_m
            usable += used[i]
        if usable >= 4:
            for _ in range(iterations):
                _accumulate(T, points_w, px, W, used, lens, nearest_m, 0.0 if is_last else huber, H, g)
                if not _solve(H, g, step):
                    return False, T, active, H
                T = _moved(T, step)
                if np.max(np.abs(step)) < limit:
                    break
        if np.max(np.abs(T - T_whitened)) > rewhiten:
            _whiten(T, points_w, covariance_w, sigma_px, lens, nearest_m, W)
            T_whitened = T
        for i in range(count):
            p = points_w[i]
            z = _in_camera(T, p)[2]
            ru, rv = _row(T, p, px[i], W[i], lens, nearest_m, J)
            active[i] = z > nearest_m and ru * ru + rv * rv < gate
    return True, T, active, H


@compiled
def equations_by_cell(
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
    lens: _Intrinsics,
    size: tuple[int, int],
    cells: int,
    nearest_m: float,
) -> tuple[Floats, Floats]:
    """Hessian ``(6, 6)`` of all matches, and the sums ``(K, 6)`` of their gradients by cell of the image.

    Args:
        size: width and height of the image; ``cells`` along each side, of which ``K`` hold any match.
    """
    count = len(points_w)
    W = np.empty((count, 3))
    _whiten(T_camera_world, points_w, covariance_w, sigma_px, lens, nearest_m, W)
    H, J = np.zeros((6, 6)), np.empty((2, 6))
    sums = np.zeros((cells * cells, 6))
    is_filled = np.zeros(cells * cells, np.bool_)
    for i in range(count):
        ru, rv = _row(T_camera_world, points_w[i], px[i], W[i], lens, nearest_m, J)
        column = int(min(max(px[i, 0] * (cells / size[0]), 0.0), cells - 1.0))
        row = int(min(max(px[i, 1] * (cells / size[1]), 0.0), cells - 1.0))
        cell = cells * row + column
        is_filled[cell] = True
        for m in range(6):
            sums[cell, m] += J[0, m] * ru + J[1, m] * rv
            for n in range(m + 1):
                H[m, n] += J[0, m] * J[0, n] + J[1, m] * J[1, n]
    _symmetrise(H)
    return H, sums[is_filled]


def load() -> None:
    """Compile everything here, or read it from the cache."""
    points, covariance, px, one = np.ones((6, 3)), np.ones((6, 3, 3)), np.ones((6, 2)), np.ones(6)
    lens = (1.0, 1.0, 0.0, 0.0)
    refine(np.eye(4), points, covariance, px, one, lens, 2, 1, 5.0, 1.0, 0.1, (1e-5, 1e-4), 0.01)
    equations_by_cell(np.eye(4), points, covariance, px, one, lens, (8, 8), 8, 0.1)
