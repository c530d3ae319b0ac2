# SPDX-License-Identifier: Apache-2.0
"""The pose of one camera from points of the map whose depth may be uncertain.

A point born from a predicted depth is sure across its ray and unsure along it. Its
covariance is carried into the image, so that its residual counts fully across the
epipolar line and little along it: the same code is PnP for a well triangulated map,
and essentially epipolar geometry plus a weak depth for a fresh one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import se3_exp
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

CHI2_2DOF_95 = 5.991
HUBER = 1.345


@dataclass(frozen=True)
class PoseEstimate:
    """A refined pose.

    Attributes:
        T_camera_world: ``(4, 4)``.
        inliers: ``(N,)`` bool.
        information: ``(6, 6)`` of the left perturbation (translation, rotation) of
            ``T_camera_world``.
    """

    T_camera_world: Floats
    inliers: NDArray[np.bool_]
    information: Floats


def projection_jacobian(camera: Camera, points_c: Floats) -> Floats:
    """``(N, 2, 3)`` derivative of the pixel by the point in the camera frame."""
    x, y = points_c[:, 0], points_c[:, 1]
    iz = 1.0 / points_c[:, 2]
    J = np.zeros((len(points_c), 2, 3))
    J[:, 0, 0] = camera.fx * iz
    J[:, 0, 2] = -camera.fx * x * iz * iz
    J[:, 1, 1] = camera.fy * iz
    J[:, 1, 2] = -camera.fy * y * iz * iz
    return J


def pixel_covariance(
    camera: Camera, T_camera_world: Floats, points_c: Floats, covariance_w: Floats, sigma_px: Floats
) -> Floats:
    """``(N, 2, 2)`` covariance of where points appear, in square pixels.

    Args:
        points_c: ``(N, 3)`` camera frame; covariance_w: ``(N, 3, 3)`` world frame, m^2;
        sigma_px: ``(N,)`` measurement noise.
    """
    J = projection_jacobian(camera, points_c) @ T_camera_world[:3, :3]
    S = J @ covariance_w @ np.swapaxes(J, 1, 2)
    S[:, 0, 0] += sigma_px**2
    S[:, 1, 1] += sigma_px**2
    return S


def _whitening(S: Floats) -> Floats:
    """``(N, 2, 2)`` lower triangular W with W S W^T = I."""
    a = np.sqrt(S[:, 0, 0])
    b = S[:, 0, 1] / a
    c = np.sqrt(np.maximum(S[:, 1, 1] - b * b, 1e-12))
    W = np.zeros_like(S)
    W[:, 0, 0] = 1.0 / a
    W[:, 1, 0] = -b / (a * c)
    W[:, 1, 1] = 1.0 / c
    return W


def refine_pose(
    camera: Camera,
    T_camera_world: Floats,
    points_w: Floats,
    covariance_w: Floats,
    px: Floats,
    sigma_px: Floats,
    *,
    rounds: int = 4,
    iterations: int = 4,
    gate: float = CHI2_2DOF_95,
) -> PoseEstimate:
    """Robust Gauss-Newton on the reprojection error, whitened by every point's covariance.

    Args:
        T_camera_world: ``(4, 4)`` start.
        points_w: ``(N, 3)`` m; covariance_w: ``(N, 3, 3)`` m^2.
        px: ``(N, 2)`` undistorted pixels; sigma_px: ``(N,)``.
        rounds: outliers are judged anew after each; Huber kernel in all but the last.
        gate: squared whitened residual beyond which a match is an outlier.
    """
    T = T_camera_world.copy()
    n = len(points_w)
    active = np.ones(n, dtype=bool)
    H = np.eye(6) * 1e-6
    for round_ in range(rounds):
        robust = round_ < rounds - 1
        Pc = points_w @ T[:3, :3].T + T[:3, 3]
        front = Pc[:, 2] > 0.02
        W = np.zeros((n, 2, 2))
        W[front] = _whitening(pixel_covariance(camera, T, Pc[front], covariance_w[front], sigma_px[front]))
        for _ in range(iterations):
            use = np.flatnonzero(active & front)
            if len(use) < 4:
                break
            P, Wu = Pc[use], W[use]
            r = np.empty((len(use), 2))
            r[:, 0] = camera.fx * P[:, 0] / P[:, 2] + camera.cx - px[use, 0]
            r[:, 1] = camera.fy * P[:, 1] / P[:, 2] + camera.cy - px[use, 1]
            J = Wu @ projection_jacobian(camera, P)
            r = np.einsum("nij,nj->ni", Wu, r)
            norm = np.sqrt(np.einsum("ni,ni->n", r, r))
            weight = (
                np.where(norm > HUBER, HUBER / np.maximum(norm, 1e-12), 1.0) if robust else np.ones(len(use))
            )
            Jp = _pose_jacobian(J, P)
            Jw = Jp * weight[:, None, None]
            H = np.einsum("nki,nkj->ij", Jw, Jp)
            g = np.einsum("nki,nk->i", Jw, r)
            step = -np.linalg.solve(H + np.eye(6) * 1e-9 * np.trace(H), g)
            T = se3_exp(step) @ T
            Pc = points_w @ T[:3, :3].T + T[:3, 3]
            front = Pc[:, 2] > 0.02
            if np.abs(step).max() < 1e-6:
                break
        active = front & (_squared_residual(camera, T, points_w, covariance_w, px, sigma_px) < gate)
    return PoseEstimate(T, active, H)


def _pose_jacobian(J_point: Floats, points_c: Floats) -> Floats:
    """Chain ``(N, k, 3)`` by the left perturbation of the pose: ``(N, k, 6)``."""
    J = np.empty((*J_point.shape[:2], 6))
    J[:, :, :3] = J_point
    x, y, z = points_c[:, 0, None], points_c[:, 1, None], points_c[:, 2, None]
    # d(omega x p)/d omega = -[p]_x
    J[:, :, 3] = J_point[:, :, 2] * y - J_point[:, :, 1] * z
    J[:, :, 4] = J_point[:, :, 0] * z - J_point[:, :, 2] * x
    J[:, :, 5] = J_point[:, :, 1] * x - J_point[:, :, 0] * y
    return J


def _squared_residual(
    camera: Camera, T: Floats, points_w: Floats, covariance_w: Floats, px: Floats, sigma_px: Floats
) -> Floats:
    Pc = points_w @ T[:3, :3].T + T[:3, 3]
    out = np.full(len(Pc), np.inf)
    front = np.flatnonzero(Pc[:, 2] > 0.02)
    P = Pc[front]
    W = _whitening(pixel_covariance(camera, T, P, covariance_w[front], sigma_px[front]))
    r = np.stack([camera.fx * P[:, 0] / P[:, 2] + camera.cx, camera.fy * P[:, 1] / P[:, 2] + camera.cy], 1)
    r = np.einsum("nij,nj->ni", W, r - px[front])
    out[front] = np.einsum("ni,ni->n", r, r)
    return out


def pose_from_scratch(
    camera: Camera, points_w: Floats, px: Floats, *, seed: int, threshold_px: float = 6.0, minimum: int = 12
) -> tuple[Floats, NDArray[np.bool_]] | None:
    """PnP without a start, by a robust consensus (OpenCV's USAC local optimisation, MSAC score).

    Returns:
        ``(T_camera_world, inliers (N,))``, or None where no pose has ``minimum`` inliers.
    """
    import cv2

    if len(points_w) < minimum:
        return None
    params = cv2.UsacParams()
    params.randomGeneratorState = seed
    params.confidence = 0.999
    params.maxIterations = 1000
    params.threshold = threshold_px
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    ok, _, rvec, tvec, index = cv2.solvePnPRansac(
        np.ascontiguousarray(points_w)[:, None],
        np.ascontiguousarray(px)[:, None],
        camera.K,
        None,
        params=params,
    )
    if not ok or index is None or len(index) < minimum:
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rvec)[0]
    T[:3, 3] = np.ravel(tvec)
    if not np.isfinite(T).all():
        return None
    inliers = np.zeros(len(points_w), dtype=bool)
    inliers[np.ravel(index)] = True
    return T, inliers
