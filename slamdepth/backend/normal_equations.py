# SPDX-License-Identifier: Apache-2.0
"""The normal equations of a bundle adjustment, by observation.

With ``A`` the derivative of the whitened residuals by the point in the camera frame, an observation adds
``L G L^T`` to its camera, ``R^T G R`` to its point and ``L G R`` between the two. ``R`` is the camera's
rotation, ``G = A^T A`` has five numbers that are not 0, and the rows of ``L (7, 3)`` say how the point moves
when the camera is shifted, turned (``[P]x``), or its depth scale grows (``-P``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.backend.point_blocks import SYMMETRIC
from slamdepth.backend.sightings import Seen, Sightings, State
from slamdepth.types import Camera
from slamdepth.typing import Floats

CAM = 7
"""Unknowns of a camera: translation, rotation, log depth scale."""
# where the sums over the observations of a camera go in its block
_ENTRIES = (
    (0, 0), (0, 2), (1, 1), (1, 2), (2, 2),
    (3, 0), (3, 1), (3, 2), (4, 0), (4, 1), (4, 2), (5, 0), (5, 1), (5, 2),
    (3, 3), (3, 4), (3, 5), (4, 4), (4, 5), (5, 5),
    (6, 2), (6, 3), (6, 4),
)  # fmt: skip


@dataclass(frozen=True)
class Border:
    """What the readout time, common to all cameras, adds to the normal equations.

    Attributes:
        k: ``(3, N)`` derivative by the point in the camera frame times that by the readout time.
        Hrp: ``(3, P)``; Hrr, br: numbers.
    """

    k: Floats
    Hrp: Floats
    Hrr: float
    br: float


@dataclass(frozen=True)
class System:
    """The normal equations.

    Attributes:
        Hpp: ``(6, P)`` upper triangle of the block of each point; bp: ``(3, P)``.
        Hcc: ``(K, 7, 7)`` block of each slot, see :class:`Sightings`.
        W: ``(4, 3, N)`` of each observation: ``G R``, and the row of the depth scale, ``-P^T G R``.
        h: ``(3, N)`` ``A^T r``; P: ``(3, N)`` see :class:`Seen`.
        border: None where the readout time is left alone.
    """

    Hpp: Floats
    bp: Floats
    Hcc: Floats
    W: Floats
    h: Floats
    P: Floats
    border: Border | None = None


def linearise(camera: Camera, sightings: Sightings, state: State, seen: Seen) -> System:
    """The normal equations of what is seen of a state."""
    R = sightings.rotations(state)
    G, h = _gram(camera, sightings, seen)
    W = np.empty((4, *R.shape[1:]))
    Hpp = _point_blocks(sightings, R, G, W)
    np.multiply(R[2], G[5], out=W[3])
    border = None if sightings.px_rate is None else _border(camera, sightings, R, seen)
    Hcc = _camera_blocks(sightings, seen.P, G)
    return System(Hpp, _turned_by_point(sightings, R, h), Hcc, W, h, seen.P, border)


def point_system(camera: Camera, sightings: Sightings, state: State, seen: Seen) -> tuple[Floats, Floats]:
    """``Hpp (6, P)`` and ``bp (3, P)`` alone, see :class:`System`."""
    R = sightings.rotations(state)
    G, h = _gram(camera, sightings, seen)
    return _point_blocks(sightings, R, G, np.empty_like(R)), _turned_by_point(sightings, R, h)


def coupling(P: Floats, V: Floats, scale: Floats) -> Floats:
    """``L V`` of observations at ``P (3, N)``, for ``V (3, 3, N)``, as ``(N, 3, 7)``.

    Args:
        scale: ``(3, N)`` its row of the depth scale.
    """
    x, y, z = P
    Z = np.empty((CAM, 3, len(x)))
    Z[:3] = V
    np.subtract(y * V[2], z * V[1], out=Z[3])
    np.subtract(z * V[0], x * V[2], out=Z[4])
    np.subtract(x * V[1], y * V[0], out=Z[5])
    Z[6] = scale
    return np.ascontiguousarray(Z.T)


def moved_with_camera(P: Floats, v: Floats) -> Floats:
    """``L v`` for vectors ``(3, N)`` of observations at ``P (3, N)``, as ``(7, N)``."""
    x, y, z = P
    out = np.empty((CAM, v.shape[1]))
    out[:3] = v
    out[3] = y * v[2] - z * v[1]
    out[4] = z * v[0] - x * v[2]
    out[5] = x * v[1] - y * v[0]
    out[6] = -(x * v[0] + y * v[1] + z * v[2])
    return out


def motion_of_points(P: Floats, delta: Floats) -> Floats:
    """``L^T delta (3, N)`` for steps ``(7, N)`` of the cameras of observations at ``P (3, N)``."""
    x, y, z = P
    out = delta[:3] - P * delta[6]
    turn_x, turn_y, turn_z = delta[3:6]
    out[0] += turn_y * z - turn_z * y
    out[1] += turn_z * x - turn_x * z
    out[2] += turn_x * y - turn_y * x
    return np.asarray(out)


def _gram(camera: Camera, sightings: Sightings, seen: Seen) -> tuple[Floats, Floats]:
    """Elements 00, 02, 11, 12, 22 of ``G`` and what depth adds to ``-P^T G``, ``(6, N)``; ``h (3, N)``."""
    inv_z = 1.0 / seen.P[2]
    tan_x, tan_y = seen.P[:2] * inv_z
    along_u, along_v = camera.fx * inv_z, camera.fy * inv_z
    px = seen.weight[0] * sightings.inv_sigma_px
    log = seen.weight[1] * sightings.inv_sigma_log * inv_z
    h = np.empty_like(seen.P)
    np.multiply(along_u * px, seen.r[0], out=h[0])
    np.multiply(along_v * px, seen.r[1], out=h[1])
    h[2] = log * seen.r[2] - h[0] * tan_x - h[1] * tan_y
    px *= sightings.inv_sigma_px
    log *= sightings.inv_sigma_log
    G = np.empty((6, len(inv_z)))
    np.multiply(along_u * along_u, px, out=G[0])
    np.multiply(-G[0], tan_x, out=G[1])
    np.multiply(along_v * along_v, px, out=G[2])
    np.multiply(-G[2], tan_y, out=G[3])
    G[4] = log * inv_z - G[1] * tan_x - G[3] * tan_y
    np.negative(log, out=G[5])
    return G, h


def _point_blocks(sightings: Sightings, R: Floats, G: Floats, W: Floats) -> Floats:
    """``R^T G R`` by point, ``(6, P)``; ``G R`` is written to ``W (3, 3, N)``."""
    W[0] = G[0] * R[0] + G[1] * R[2]
    W[1] = G[2] * R[1] + G[3] * R[2]
    W[2] = G[1] * R[0] + G[3] * R[1] + G[4] * R[2]
    return np.stack([
        sightings.by_point(R[0, i] * W[0, j] + R[1, i] * W[1, j] + R[2, i] * W[2, j]) for i, j in SYMMETRIC
    ])  # fmt: skip


def _turned_by_point(sightings: Sightings, R: Floats, v: Floats) -> Floats:
    """``R^T v`` summed over the observations of each point, ``(3, P)``."""
    turned = R[0] * v[0]
    turned += R[1] * v[1]
    turned += R[2] * v[2]
    return np.stack([sightings.by_point(row) for row in turned])


def _camera_blocks(sightings: Sightings, P: Floats, G: Floats) -> Floats:
    """``L G L^T`` summed over the observations of each slot, ``(K, 7, 7)``; of fixed ones the scale alone."""
    scale = sightings.by_slot(-G[5:] * P[2])
    x, y, z = P[:, : sightings.moving]
    g00, g02, g11, g12, g22, depth = G[:, : sightings.moving]
    rows = np.empty((len(_ENTRIES), len(z)))
    rows[:5] = g00, g02, g11, g12, g22
    (u30, u31, u32), (u40, u41, u42), (u50, u51, u52) = rows[5:14].reshape(3, 3, -1)  # [P]x G
    np.multiply(y, g02, out=u30)
    np.subtract(y * g12, z * g11, out=u31)
    np.subtract(y * g22, z * g12, out=u32)
    np.subtract(z * g00, x * g02, out=u40)
    np.multiply(-x, g12, out=u41)
    np.subtract(z * g02, x * g22, out=u42)
    np.multiply(-y, g00, out=u50)
    np.multiply(x, g11, out=u51)
    np.subtract(x * g12, y * g02, out=u52)
    np.subtract(y * u32, z * u31, out=rows[14])
    np.subtract(z * u30, x * u32, out=rows[15])
    np.subtract(x * u31, y * u30, out=rows[16])
    np.subtract(z * u40, x * u42, out=rows[17])
    np.subtract(x * u41, y * u40, out=rows[18])
    np.subtract(x * u51, y * u50, out=rows[19])
    rows[20] = depth
    np.multiply(y, depth, out=rows[21])
    np.multiply(-x, depth, out=rows[22])
    sums = sightings.by_slot(rows)
    H = np.zeros((len(sums), CAM, CAM))
    for row, (i, j) in enumerate(_ENTRIES):
        H[:, i, j] = H[:, j, i] = sums[:, row]
    H[:, 6, 6] = scale[:, 0]
    return H


def _border(camera: Camera, sightings: Sightings, R: Floats, seen: Seen) -> Border:
    assert sightings.px_rate is not None
    x, y, z = seen.P
    rate = -sightings.px_rate * sightings.inv_sigma_px
    weighted = rate * seen.weight[0]
    whitened = weighted * sightings.inv_sigma_px
    k = np.empty_like(seen.P)
    k[0], k[1] = whitened[0] * camera.fx / z, whitened[1] * camera.fy / z
    k[2] = -(k[0] * x + k[1] * y) / z
    Hrp = _turned_by_point(sightings, R, k)
    return Border(k, Hrp, float((weighted * rate).sum()), float((weighted * seen.r[:2]).sum()))
