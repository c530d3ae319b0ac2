# SPDX-License-Identifier: Apache-2.0
"""Pure functions of rigid motion and pinhole projection; nothing here keeps state.

Tangents of SE(3) are ``(translation, rotation)`` unless a name says otherwise; the one
adapter to GTSAM (rotation first) lives in ``slamdepth.backend``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamdepth.types import Camera
from slamdepth.typing import Floats

CHI2_2DOF_95 = 5.991
"""95 % of the squared whitened errors of a pixel are smaller: chi-square with two degrees of freedom."""
CHI2_2DOF_99 = 9.21
"""99 % of the squared whitened errors of a pixel are smaller."""


def invert(T: Floats) -> Floats:
    """Inverse of rigid transforms ``(..., 4, 4)``."""
    R = T[..., :3, :3]
    inverse: Floats = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(R, -1, -2)
    inverse[..., :3, 3] = -np.einsum("...ji,...j->...i", R, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def transform(T_a_b: Floats, points_b: Floats) -> Floats:
    """Points ``(N, 3)`` of frame b in frame a."""
    points_a: Floats = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    return points_a


def skew(v: Floats) -> Floats:
    """Cross product matrices ``(..., 3, 3)`` of vectors ``(..., 3)``."""
    v = np.asarray(v, dtype=np.float64)
    out: Floats = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(omega: Floats) -> Floats:
    """Rotation matrices ``(..., 3, 3)`` of rotation vectors ``(..., 3)`` in radians (Rodrigues)."""
    omega = np.asarray(omega, dtype=np.float64)
    if omega.ndim == 1:
        return _so3_exp_single(*omega.tolist())
    theta2 = np.sum(omega * omega, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta2 < 1e-12
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    W = skew(omega)
    R: Floats = np.eye(3) + a * W + b * (W @ W)
    return R


def _so3_exp_single(x: float, y: float, z: float) -> Floats:
    """Rotation matrix ``(3, 3)`` of one rotation vector, in scalar arithmetic, which is faster for one."""
    xx, yy, zz = x * x, y * y, z * z
    theta2 = xx + yy + zz
    if theta2 < 1e-12:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        theta = math.sqrt(theta2)
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2
    return np.array(
        [
            [1.0 - b * (yy + zz), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (xx + zz), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (xx + yy)],
        ]
    )


def so3_log(R: Floats) -> Floats:
    """Rotation vectors ``(..., 3)`` in radians of rotation matrices ``(..., 3, 3)``.

    Through the quaternion, which stays accurate near zero and near half a turn.
    """
    if R.ndim == 2:
        return _so3_log_single(R)
    quat = rotation_to_quat_xyzw(R)
    vector, w = quat[..., :3], quat[..., 3]
    length = np.linalg.norm(vector, axis=-1)
    angle = 2.0 * np.arctan2(length, w)
    small = length < 1e-9
    factor = np.where(small, 2.0, angle / np.where(small, 1.0, length))
    return factor[..., None] * vector


def _so3_log_single(R: Floats) -> Floats:
    """Rotation vector ``(3,)`` of one rotation matrix, in scalar arithmetic; the same to the last bit."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R.tolist()
    squares = (r00 - r11 - r22, r11 - r00 - r22, r22 - r00 - r11, r00 + r11 + r22)
    largest = squares.index(max(squares))
    top = 1.0 + squares[largest]
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    candidates = ((top, xy, xz, wx), (xy, top, yz, wy), (xz, yz, top, wz), (wx, wy, wz, top))
    x, y, z, w = candidates[largest]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        norm = -norm
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    length = math.sqrt(x * x + y * y + z * z)
    # NumPy's own arctan2: the mathematical library's may differ in the last bit
    factor = 2.0 if length < 1e-9 else 2.0 * float(np.arctan2(length, w)) / length
    return np.array([factor * x, factor * y, factor * z])


def se3_exp(xi: Floats) -> Floats:
    """Rigid transforms ``(..., 4, 4)`` of tangents ``(..., 6)``, translation first.

    Rotation by the exponential map, translation taken as it is: a retraction of
    R^3 x SO(3), which is what the optimisers here step on.
    """
    xi = np.asarray(xi, dtype=np.float64)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = so3_exp(xi[..., 3:])
    T[..., :3, 3] = xi[..., :3]
    T[..., 3, 3] = 1.0
    return T


def se3_log(T: Floats) -> Floats:
    """Tangents ``(..., 6)`` of rigid transforms ``(..., 4, 4)``; the inverse of :func:`se3_exp`."""
    return np.concatenate([T[..., :3, 3], so3_log(T[..., :3, :3])], axis=-1)


def rotation_angle_rad(R: Floats) -> Floats:
    """Angles ``(...)`` in radians of rotation matrices ``(..., 3, 3)``."""
    angles: Floats = np.linalg.norm(so3_log(R), axis=-1)
    return angles


def orthonormalised(T: Floats) -> Floats:
    """Rigid transforms ``(..., 4, 4)`` whose rotations are exactly orthonormal again."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    det = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= det[..., None]
    out: Floats = T.copy()
    out[..., :3, :3] = U @ Vt
    return out


def look_at(eye_w: Floats, target_w: Floats, down_w: Floats) -> Floats:
    """``T_world_camera (4, 4)`` of a level camera at ``eye_w (3,)`` with ``target_w (3,)`` in its centre.

    Args:
        down_w: ``(3,)`` direction of gravity, not parallel to the view.
    """
    T = np.eye(4)
    ahead = (target_w - eye_w) / np.linalg.norm(target_w - eye_w)
    right = np.cross(down_w, ahead)
    right /= np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = eye_w
    return T


def quat_xyzw_to_rotation(quat_xyzw: Floats) -> Floats:
    """Rotation matrices ``(..., 3, 3)`` of quaternions ``(..., 4)`` in TUM order x y z w."""
    q = np.asarray(quat_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    return R


def rotation_to_quat_xyzw(R: Floats) -> Floats:
    """Quaternions ``(..., 4)`` x y z w with w >= 0 of rotation matrices ``(..., 3, 3)``.

    Divides by the largest of the four candidates (Shepperd 1978), never by a small number.
    """
    R = np.asarray(R, dtype=np.float64)
    m = R.reshape(-1, 3, 3)
    d0, d1, d2 = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([d0 - d1 - d2, d1 - d0 - d2, d2 - d0 - d1, d0 + d1 + d2], axis=1)
    largest = squares.argmax(axis=1)
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    top = 1.0 + squares[np.arange(len(m)), largest]
    candidates = np.stack(
        [
            np.stack([top, xy, xz, wx], axis=1),
            np.stack([xy, top, yz, wy], axis=1),
            np.stack([xz, yz, top, wz], axis=1),
            np.stack([wx, wy, wz, top], axis=1),
        ],
        axis=1,
    )
    quat = candidates[np.arange(len(m)), largest]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    quat *= np.where(quat[:, 3:] < 0, -1.0, 1.0)
    quat_xyzw: Floats = quat.reshape(*R.shape[:-2], 4)
    return quat_xyzw


def project(camera: Camera, points_c: Floats) -> tuple[Floats, Floats]:
    """Project points ``(N, 3)`` of the camera frame, without distortion.

    Returns:
        Pixels ``(N, 2)`` and depths ``(N,)``; pixels of points at or behind the image
        plane are meaningless, so check the depth.
    """
    z = points_c[:, 2]
    safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    px = np.empty((len(z), 2))
    px[:, 0] = camera.fx * points_c[:, 0] / safe + camera.cx
    px[:, 1] = camera.fy * points_c[:, 1] / safe + camera.cy
    return px, z


def reprojection_errors(camera: Camera, points_c: Floats, px: Floats, nearest_m: float) -> Floats:
    """Projections less measured pixels, ``(2, N)``, without distortion.

    Arrays are by coordinate, for optimisers: NumPy is fast at a few long rows.

    Args:
        points_c: ``(3, N)`` in the camera frame, metres.
        px: ``(2, N)`` where they were measured, undistorted.
        nearest_m: points nearer than this or behind the camera are projected from this depth.
    """
    z = np.maximum(points_c[2], nearest_m)
    errors = np.empty((2, len(z)))
    errors[0] = camera.fx * points_c[0] / z + (camera.cx - px[0])
    errors[1] = camera.fy * points_c[1] / z + (camera.cy - px[1])
    return errors


def backproject(camera: Camera, points_px: Floats, depth_m: Floats) -> Floats:
    """Points ``(N, 3)`` of the camera frame from undistorted pixels ``(N, 2)`` and depths ``(N,)``."""
    x = (points_px[:, 0] - camera.cx) / camera.fx * depth_m
    y = (points_px[:, 1] - camera.cy) / camera.fy * depth_m
    return np.stack([x, y, depth_m], axis=1)


def umeyama(source: Floats, target: Floats, with_scale: bool) -> tuple[float, Floats, Floats]:
    """Least-squares ``target = scale * R @ source + t`` for ``(N, 3)`` points (Umeyama 1991).

    Returns:
        ``(scale, R (3, 3), t (3,))``; the scale is 1 unless ``with_scale``.
    """
    mu_s, mu_t = source.mean(axis=0), target.mean(axis=0)
    ds, dt = source - mu_s, target - mu_t
    U, S, Vt = np.linalg.svd(dt.T @ ds / len(source))
    sign = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        sign[2] = -1.0
    R = (U * sign) @ Vt
    scale = 1.0
    if with_scale:
        variance = np.mean(np.sum(ds * ds, axis=1))
        scale = float(np.sum(S * sign) / variance) if variance > 0 else 1.0
    return scale, R, mu_t - scale * R @ mu_s


@dataclass(frozen=True)
class Similarity:
    """``p_a = scale * R p_b + t``: two frames with metres of their own.

    Attributes:
        scale: metres of a that one of b is.
        T_a_b: ``(4, 4)`` rotation, and translation in metres of a.
    """

    scale: float
    T_a_b: Floats

    @staticmethod
    def of_camera(T_a_camera: Floats, T_b_camera: Floats, scale: float) -> Similarity:
        """From one camera's pose in both frames, ``(4, 4)`` each, and the ratio of their metres."""
        T_b_camera_in_a = T_b_camera.copy()
        T_b_camera_in_a[:3, 3] *= scale
        return Similarity(scale, T_a_camera @ invert(T_b_camera_in_a))

    def camera(self, T_b_camera: Floats) -> Floats:
        """Poses ``(..., 4, 4)`` of cameras in frame a, given those in frame b."""
        moved: Floats = T_b_camera.copy()
        moved[..., :3, 3] *= self.scale
        return self.T_a_b @ moved

    def inverse(self) -> Similarity:
        """The similarity from a to b."""
        T_b_a = invert(self.T_a_b)
        T_b_a[:3, 3] /= self.scale
        return Similarity(1.0 / self.scale, T_b_a)
