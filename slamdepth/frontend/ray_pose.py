# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame in a map whose predicted depth is not believed: landmarks as rays of unknown length.

Where a network does not know a kind of image, it places a city at three metres, and the first-order
covariance there is a measurement of the motion across the ray which nobody made. So the pose is estimated
together with the inverse depth of each landmark along its ray (Civera et al., "Inverse depth parametrization
for monocular SLAM", 2008). A predicted depth that is grossly wrong says nothing; the others keep the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.pose import HUBER, PoseEstimate
from slamdepth.frontend.wide_pose import NEAREST_M, Sighting
from slamdepth.geometry import CHI2_2DOF_95, se3_exp
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats

_WRONG = 2.0  # deviations of its log depth by which a prediction counts as grossly wrong
_LEAST_Q = 1e-6
_LEAST_SIGMA = 0.002  # relative deviation of a distance: the poses that triangulated it err, too
_FEWEST = 6
_GAIN = 1e-4  # relative fall of the cost below which another step is not worth its time


@dataclass(frozen=True)
class RaySighting(Sighting):
    """Landmarks, where they were first seen from, and where a frame sees them.

    Attributes:
        origin_w: ``(N, 3)`` m, the camera centre that each was first seen from.
        inflation: ``(N,)`` factor on the deviation of its distance from there: above 1 where that is only
            predicted, since neighbours in an image share the error.
    """

    origin_w: Floats
    inflation: Floats


@dataclass(frozen=True)
class RayPose(PoseEstimate):
    """A pose and what it explains.

    Attributes:
        cost: sum of squared whitened residuals, each at most as large as an outlier's (MSAC).
    """

    cost: float


def pose_with_depths(
    camera: Camera, T_camera_world: Floats, seen: RaySighting, *, rounds: int = 3, iterations: int = 8
) -> RayPose:
    """Refine a pose together with the inverse depth of each landmark along the ray it was first seen on.

    Where a depth is uncertain, its covariance in the image depends on where the landmark really is, so a
    first order at the predicted place is not enough: a point predicted at 3 m and seen at infinity would tell
    of a motion that it knows nothing of. The depths are eliminated (Schur complement).

    Args:
        T_camera_world: ``(4, 4)`` initial pose.
        rounds: outliers are classified again after each.
        iterations: Gauss-Newton steps of a round, at most.
    """
    match = _Rays(camera, seen)
    T, q = T_camera_world, match.triangulated(T_camera_world)
    keep = np.ones(len(seen.px), dtype=np.bool_)
    damping = 1e-6
    for round_ in range(rounds):
        cost = match.cost(T, q, keep)
        for _ in range(iterations):
            step, dq, _ = match.newton_step(T, q, keep, damping)
            T_new, q_new = se3_exp(step) @ T, np.clip(q + dq, _LEAST_Q, match.most_q)
            new_cost = match.cost(T_new, q_new, keep)
            if not new_cost < cost:
                damping = min(10.0 * damping, 1.0)
                if damping == 1.0:
                    break
                continue
            gain, cost = cost - new_cost, new_cost
            T, q, damping = T_new, q_new, max(0.1 * damping, 1e-9)
            if gain < _GAIN * cost:
                break
        q = np.where(keep, q, match.triangulated(T))
        keep = match.squared_residual(T, q) < CHI2_2DOF_95
        damping = 1e-6
        if round_ == rounds - 1 or np.count_nonzero(keep) < _FEWEST:
            break
    _, _, information = match.newton_step(T, q, keep, 0.0)
    cost = float(np.minimum(match.squared_residual(T, q), CHI2_2DOF_95).sum())
    return RayPose(T, keep, information, cost)


class _Rays:
    """Landmarks as rays: ``q`` is the inverse of a distance in units of the landmark's own, 0 at infinity.

    In the camera a landmark is at ``p = q o + d`` up to scale, ``o`` where its first camera is and ``d`` its
    offset from there.
    """

    def __init__(self, camera: Camera, seen: RaySighting) -> None:
        offset_w = seen.points_w - seen.origin_w
        distance = np.maximum(np.linalg.norm(offset_w, axis=1), NEAREST_M)
        ray = offset_w / distance[:, None]
        along = np.einsum("ni,nij,nj->n", ray, seen.covariance_w, ray)
        across = np.maximum(np.trace(seen.covariance_w, axis1=1, axis2=2) - along, 0.0) / 2.0
        self.camera, self.px = camera, seen.px.T
        self.origin_w, self.offset_w = seen.origin_w.T, offset_w.T
        self.inv_sigma_px = 1.0 / np.sqrt(seen.sigma_px**2 + (camera.fx / distance) ** 2 * across)
        self.sigma = np.maximum(np.sqrt(along) / distance, _LEAST_SIGMA)
        self.is_predicted = seen.inflation > 1.0
        self.precision = 1.0 / (self.sigma * seen.inflation) ** 2
        self.most_q = distance / NEAREST_M

    def _in_camera(self, T: Floats) -> tuple[Floats, Floats]:
        R, t = T[:3, :3], T[:3, 3:]
        return R @ self.origin_w + t, R @ self.offset_w

    def _prior(self, q: Floats) -> Floats:
        """Precision ``(N,)`` of ``q - 1``. A prediction that is grossly wrong says nothing: Geman-McClure."""
        off = np.log(q) / (_WRONG * self.sigma)
        return np.asarray(self.precision * np.where(self.is_predicted, 1.0 / (1.0 + off * off) ** 2, 1.0))

    def triangulated(self, T: Floats) -> Floats:
        """``q (N,)`` by linear least squares from the two rays and the prior."""
        o, d = self._in_camera(T)
        u = (self.px - [[self.camera.cx], [self.camera.cy]]) / [[self.camera.fx], [self.camera.fy]]
        rows, offset = o[:2] - u * o[2], u * d[2] - d[:2]
        gain = (self.camera.fx * self.inv_sigma_px / np.maximum(d[2], NEAREST_M)) ** 2
        both = gain * (rows * offset).sum(axis=0), gain * (rows * rows).sum(axis=0)
        return np.asarray(
            np.clip((both[0] + self.precision) / (both[1] + self.precision), _LEAST_Q, self.most_q)
        )

    def _residual(self, T: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
        """Whitened pixels ``(2, N)``, the points ``p (3, N)`` and ``o``; behind the camera it is large."""
        o, d = self._in_camera(T)
        p = q * o + d
        z = np.maximum(p[2], 1e-6)
        r = np.stack(
            [
                self.camera.fx * p[0] / z + self.camera.cx - self.px[0],
                self.camera.fy * p[1] / z + self.camera.cy - self.px[1],
            ]
        )
        return np.clip(r, -1e4, 1e4) * self.inv_sigma_px, p, o

    def squared_residual(self, T: Floats, q: Floats) -> Floats:
        """``(N,)`` of pixels and, where a depth is not just predicted, of the depth."""
        r, p, _ = self._residual(T, q)
        squared = (r * r).sum(axis=0) + np.where(self.is_predicted, 0.0, self.precision * (q - 1.0) ** 2)
        return np.where(p[2] > 0.0, squared, np.inf)

    def cost(self, T: Floats, q: Floats, keep: Bools) -> float:
        r, _, _ = self._residual(T, q)
        squared = (r * r).sum(axis=0)
        norm = np.sqrt(squared)
        pixel = np.where(norm > HUBER, 2.0 * HUBER * norm - HUBER**2, squared)
        return float((pixel + self._prior_cost(q))[keep].sum())

    def _prior_cost(self, q: Floats) -> Floats:
        return np.asarray(self._prior(q) * (q - 1.0) ** 2)

    def newton_step(self, T: Floats, q: Floats, keep: Bools, damping: float) -> tuple[Floats, Floats, Floats]:
        """Step of the pose ``(6,)`` and of ``q (N,)``; information ``(6, 6)`` of the pose."""
        r, p, o = self._residual(T, q)
        norm = np.sqrt((r * r).sum(axis=0))
        root = np.where(keep & (p[2] > 1e-6), np.sqrt(HUBER / np.maximum(norm, HUBER)), 0.0)
        inv_z = 1.0 / np.maximum(p[2], 1e-6)
        J = np.zeros((3, 2, len(q)))  # whitened pixel by p
        gain = root * self.inv_sigma_px
        J[0, 0], J[1, 1] = self.camera.fx * inv_z * gain, self.camera.fy * inv_z * gain
        J[2, 0], J[2, 1] = -J[0, 0] * p[0] * inv_z, -J[1, 1] * p[1] * inv_z
        r = r * root
        by_q = np.einsum("irn,in->rn", J, o)
        by_pose = np.empty((6, 2, len(q)))
        by_pose[:3] = J * q
        by_pose[3] = J[2] * p[1] - J[1] * p[2]
        by_pose[4] = J[0] * p[2] - J[2] * p[0]
        by_pose[5] = J[1] * p[0] - J[0] * p[1]
        prior = self._prior(q)
        Hqq = ((by_q * by_q).sum(axis=0) + prior) * (1.0 + damping) + 1e-12
        bq = (by_q * r).sum(axis=0) + prior * (q - 1.0)
        Hcq = np.einsum("crn,rn->cn", by_pose, by_q)
        flat = by_pose.reshape(6, -1)
        H = flat @ flat.T
        information = H - (Hcq / Hqq) @ Hcq.T
        damped = information + damping * np.diag(H.diagonal()) + 1e-12 * np.eye(6) * H.trace()
        step = -np.linalg.lstsq(damped, flat @ r.ravel() - Hcq @ (bq / Hqq), rcond=None)[0]
        return step, -(bq + step @ Hcq) / Hqq, information
