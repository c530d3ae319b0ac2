# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of keyframes, points and the depth scale of each keyframe.

Minimises, over poses, points and one log scale ``a_k`` per keyframe,

    sum  rho(|pi(T_k X_p) - u_kp|^2 / s_kp^2)              reprojection, Huber
       + sum  rho_c((log z_kp - a_k - log d_kp)^2 / t_kp^2)   depth prior, Cauchy
       + sum  a_k^2 / s_a^2                                   a keyframe's common depth error

by Levenberg-Marquardt with the points eliminated (Schur complement; Triggs et al.,
"Bundle Adjustment: A Modern Synthesis", 1999). A predicted depth errs mostly in
common over a whole image, which is what ``a_k`` takes up: without it a hundred pixels
of one prediction would count as a hundred independent measurements.

This is our own solver and not a GTSAM graph because building a graph in Python costs
as much as solving it; whole arrays in NumPy do both several times faster. A test
compares the two.
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
    Ints = NDArray[np.int64]
    Bools = NDArray[np.bool_]

CHI2_2DOF_95 = 5.991
HUBER = 1.5
CAUCHY = 2.0
_CAM = 7  # translation, rotation, log depth scale
_DENSE_LIMIT = 4_000_000  # numbers in the camera-point block before it is kept sparse
_MIN_DEPTH_M = 0.01


@dataclass(frozen=True)
class BundleProblem:
    """What is to be adjusted.

    Attributes:
        camera: pinhole; distortion is ignored, pixels are undistorted.
        T_camera_world: ``(K, 4, 4)``; fixed: ``(K,)`` poses that must not move.
        points_w: ``(P, 3)`` metres.
        obs_camera, obs_point: ``(M,)`` indices; a camera sees a point at most once.
        px: ``(M, 2)``; sigma_px: ``(M,)``.
        log_depth: ``(M,)`` log of the depth prior in metres of the map, NaN where none;
            sigma_log: ``(M,)`` its deviation.
        sigma_scale: deviation ``s_a`` of a keyframe's common log depth error; 0 pins
            the scales (sensor depth).
    """

    camera: Camera
    T_camera_world: Floats
    fixed: Bools
    points_w: Floats
    obs_camera: Ints
    obs_point: Ints
    px: Floats
    sigma_px: Floats
    log_depth: Floats
    sigma_log: Floats
    sigma_scale: float = 0.0


@dataclass(frozen=True)
class BundleResult:
    """What came out.

    Attributes:
        T_camera_world: ``(K, 4, 4)``; points_w: ``(P, 3)``; log_scale: ``(K,)``.
        covariance_w: ``(P, 3, 3)`` m^2 of each point, given the poses.
        inlier: ``(M,)`` observations that agree.
        chi2: ``(M,)`` squared whitened pixel residuals.
        initial_cost, final_cost: robust cost of the first phase's start and the end.
        iterations: steps taken.
    """

    T_camera_world: Floats
    points_w: Floats
    log_scale: Floats
    covariance_w: Floats
    inlier: Bools
    chi2: Floats
    initial_cost: float
    final_cost: float
    iterations: int


class _State:
    __slots__ = ("T", "X", "a")

    def __init__(self, T: Floats, X: Floats, a: Floats) -> None:
        self.T, self.X, self.a = T, X, a


def bundle_adjust(
    problem: BundleProblem, iterations: tuple[int, ...] = (4, 6), gate: float = CHI2_2DOF_95
) -> BundleResult:
    """Adjust ``problem``; after each phase but the last, outlying observations are set aside.

    Args:
        iterations: Levenberg-Marquardt steps at most, per phase.
        gate: squared whitened residual beyond which an observation is an outlier.
    """
    state = _State(
        problem.T_camera_world.copy(), problem.points_w.copy(), np.zeros(len(problem.T_camera_world))
    )
    keep = np.ones(len(problem.obs_camera), dtype=bool)
    first_cost: float | None = None
    cost = 0.0
    steps = 0
    solver = _Solver(problem, keep)
    for phase, limit in enumerate(iterations):
        if phase:
            chi2 = _pixel_chi2(problem, state)
            keep = chi2 < gate
            solver = _Solver(problem, keep)
        state, start, cost, taken = solver.run(state, limit)
        first_cost = start if first_cost is None else first_cost
        steps += taken
    chi2 = _pixel_chi2(problem, state)
    return BundleResult(
        T_camera_world=state.T,
        points_w=state.X,
        log_scale=state.a,
        covariance_w=solver.point_covariance(state),
        inlier=chi2 < gate,
        chi2=chi2,
        initial_cost=float(first_cost or 0.0),
        final_cost=cost,
        iterations=steps,
    )


def _pixel_chi2(problem: BundleProblem, state: _State) -> Floats:
    T = state.T[problem.obs_camera]
    P = np.einsum("nij,nj->ni", T[:, :3, :3], state.X[problem.obs_point]) + T[:, :3, 3]
    z = np.maximum(P[:, 2], _MIN_DEPTH_M)
    camera = problem.camera
    du = camera.fx * P[:, 0] / z + camera.cx - problem.px[:, 0]
    dv = camera.fy * P[:, 1] / z + camera.cy - problem.px[:, 1]
    chi2 = (du * du + dv * dv) / problem.sigma_px**2
    return np.where(P[:, 2] > _MIN_DEPTH_M, chi2, np.inf)


class _Solver:
    """Levenberg-Marquardt over one set of observations, sorted by point."""

    def __init__(self, problem: BundleProblem, keep: Bools) -> None:
        self.problem = problem
        index = np.flatnonzero(keep)
        index = index[np.argsort(problem.obs_point[index], kind="stable")]
        self.cam, self.pt = problem.obs_camera[index], problem.obs_point[index]
        self.px, self.sigma_px = problem.px[index], problem.sigma_px[index]
        has = np.isfinite(problem.log_depth[index])
        self.log_depth = np.where(has, problem.log_depth[index], 0.0)
        self.inv_sigma_log = np.where(has, 1.0 / np.where(has, problem.sigma_log[index], 1.0), 0.0)
        # a fixed pose still has a depth scale of its own to be found
        scaled = np.zeros(len(problem.fixed), dtype=bool)
        if problem.sigma_scale > 0:
            scaled[self.cam[has]] = True
        free = np.flatnonzero(~problem.fixed | scaled)
        self.free = free
        self.pinned = problem.fixed[free]
        slot = np.full(len(problem.fixed), -1)
        slot[free] = np.arange(len(free))
        self.slot = slot[self.cam]
        self.moving = np.flatnonzero(self.slot >= 0)
        self.cam_order = self.moving[np.argsort(self.slot[self.moving], kind="stable")]
        self.P, self.K = len(problem.points_w), len(free)
        self.pt_starts, self.pt_ids = _runs(self.pt)
        self.cam_starts, self.cam_ids = _runs(self.slot[self.cam_order])

    def run(self, state: _State, limit: int) -> tuple[_State, float, float, int]:
        residual, weight, P = self._residual(state)
        cost = start = self._cost(residual, state)
        damping = 1e-4
        taken = 0
        for _ in range(limit):
            taken += 1
            system = self._linearise(state, residual, weight, P)
            improved = False
            for _ in range(4):
                candidate = self._step(state, system, damping)
                new_residual, new_weight, new_P = self._residual(candidate)
                new_cost = self._cost(new_residual, candidate)
                if np.isfinite(new_cost) and new_cost < cost:
                    improved = True
                    break
                damping = min(damping * 10.0, 1e6)
            if not improved:
                break
            gain = (cost - new_cost) / max(cost, 1e-12)
            state, residual, weight, P, cost = candidate, new_residual, new_weight, new_P, new_cost
            damping = max(damping * 0.2, 1e-8)
            if gain < 1e-4:
                break
        return state, start, cost, taken

    def _residual(self, state: _State) -> tuple[Floats, Floats, Floats]:
        camera = self.problem.camera
        T = state.T[self.cam]
        P = np.einsum("nij,nj->ni", T[:, :3, :3], state.X[self.pt]) + T[:, :3, 3]
        z = np.maximum(P[:, 2], _MIN_DEPTH_M)
        P[:, 2] = z
        r = np.empty((len(P), 3))
        inv = 1.0 / self.sigma_px
        r[:, 0] = (camera.fx * P[:, 0] / z + camera.cx - self.px[:, 0]) * inv
        r[:, 1] = (camera.fy * P[:, 1] / z + camera.cy - self.px[:, 1]) * inv
        r[:, 2] = (np.log(z) - state.a[self.cam] - self.log_depth) * self.inv_sigma_log
        norm = np.sqrt(r[:, 0] ** 2 + r[:, 1] ** 2)
        weight = np.empty((len(P), 2))
        weight[:, 0] = np.where(norm > HUBER, HUBER / np.maximum(norm, 1e-12), 1.0)
        weight[:, 1] = 1.0 / (1.0 + (r[:, 2] / CAUCHY) ** 2)
        return r, weight, P

    def _cost(self, r: Floats, state: _State) -> float:
        norm = np.sqrt(r[:, 0] ** 2 + r[:, 1] ** 2)
        pixel = np.where(norm > HUBER, 2 * HUBER * norm - HUBER * HUBER, norm * norm)
        depth = CAUCHY * CAUCHY * np.log1p((r[:, 2] / CAUCHY) ** 2)
        total = float(pixel.sum() + depth.sum())
        if self.problem.sigma_scale > 0:
            total += float(np.sum((state.a / self.problem.sigma_scale) ** 2))
        return total

    def _linearise(self, state: _State, r: Floats, weight: Floats, P: Floats) -> dict[str, Floats]:
        camera = self.problem.camera
        n = len(P)
        root = np.sqrt(weight)
        inv_px = root[:, 0] / self.sigma_px
        inv_z = 1.0 / P[:, 2]
        A = np.zeros((n, 3, 3))  # residual by the point in the camera frame
        A[:, 0, 0] = camera.fx * inv_z * inv_px
        A[:, 0, 2] = -camera.fx * P[:, 0] * inv_z * inv_z * inv_px
        A[:, 1, 1] = camera.fy * inv_z * inv_px
        A[:, 1, 2] = -camera.fy * P[:, 1] * inv_z * inv_z * inv_px
        depth_gain = self.inv_sigma_log * root[:, 1]
        A[:, 2, 2] = inv_z * depth_gain
        b = r * root[:, [0, 0, 1]]
        Jp = A @ state.T[self.cam, :3, :3]
        Hpp = np.zeros((self.P, 3, 3))
        bp = np.zeros((self.P, 3))
        JpT = np.swapaxes(Jp, 1, 2)
        if n:
            Hpp[self.pt_ids] = np.add.reduceat(JpT @ Jp, self.pt_starts)
            bp[self.pt_ids] = np.add.reduceat((JpT @ b[:, :, None])[:, :, 0], self.pt_starts)
        m = self.cam_order
        Jc = np.zeros((len(m), 3, _CAM))
        Am, x, y, z = A[m], P[m, 0, None], P[m, 1, None], P[m, 2, None]
        Jc[:, :, :3] = Am
        Jc[:, :, 3] = Am[:, :, 2] * y - Am[:, :, 1] * z
        Jc[:, :, 4] = Am[:, :, 0] * z - Am[:, :, 2] * x
        Jc[:, :, 5] = Am[:, :, 1] * x - Am[:, :, 0] * y
        if self.problem.sigma_scale > 0:
            Jc[:, 2, 6] = -depth_gain[m]
        Jc[self.pinned[self.slot[m]], :, :6] = 0.0
        JcT = np.swapaxes(Jc, 1, 2)
        Hcc = np.zeros((self.K, _CAM, _CAM))
        bc = np.zeros((self.K, _CAM))
        if len(m):
            Hcc[self.cam_ids] = np.add.reduceat(JcT @ Jc, self.cam_starts)
            bc[self.cam_ids] = np.add.reduceat((JcT @ b[m][:, :, None])[:, :, 0], self.cam_starts)
        Hcc[np.flatnonzero(self.pinned)[:, None], np.arange(6), np.arange(6)] += 1.0
        if self.problem.sigma_scale > 0:
            Hcc[:, 6, 6] += 1.0 / self.problem.sigma_scale**2
            bc[:, 6] += state.a[self.free] / self.problem.sigma_scale**2
        else:
            Hcc[:, 6, 6] += 1.0
        return {"Hpp": Hpp, "bp": bp, "Hcc": Hcc, "bc": bc, "Hcp": JcT @ Jp[m]}

    def _step(self, state: _State, system: dict[str, Floats], damping: float) -> _State:
        Hpp, Hcc, Hcp = system["Hpp"], system["Hcc"], system["Hcp"]
        bp, bc = system["bp"], system["bc"]
        inverse = np.linalg.inv(_damped(Hpp, damping))
        m = self.cam_order
        cam, pt = self.slot[m], self.pt[m]
        Y = Hcp @ inverse[pt]
        size = self.K * _CAM
        S = np.zeros((size, size))
        damped = _damped(Hcc, damping)
        for k in range(self.K):
            S[k * _CAM : (k + 1) * _CAM, k * _CAM : (k + 1) * _CAM] = damped[k]
        rhs = bc.copy()
        if len(m):
            S -= self._schur(Hcp, Y, cam, pt)
            rhs[self.cam_ids] -= np.add.reduceat((Y @ bp[pt][:, :, None])[:, :, 0], self.cam_starts)
        delta_c = -_solve_positive(S, rhs.ravel()).reshape(self.K, _CAM)
        back = bp.copy()
        if len(m):
            coupling = (np.swapaxes(Hcp, 1, 2) @ delta_c[cam][:, :, None])[:, :, 0]
            for axis in range(3):
                back[:, axis] += np.bincount(pt, coupling[:, axis], minlength=self.P)
        delta_p = -(inverse @ back[:, :, None])[:, :, 0]
        T, a = state.T.copy(), state.a.copy()
        T[self.free] = se3_exp(delta_c[:, :6]) @ T[self.free]
        if self.problem.sigma_scale > 0:
            a[self.free] += delta_c[:, 6]
        return _State(T, state.X + delta_p, a)

    def _schur(self, Hcp: Floats, Y: Floats, cam: Ints, pt: Ints) -> Floats:
        size = self.K * _CAM
        if self.K * self.P * _CAM * 3 <= _DENSE_LIMIT:
            W = np.zeros((self.K, _CAM, self.P, 3))
            V = np.zeros((self.K, _CAM, self.P, 3))
            W[cam, :, pt] = Hcp
            V[cam, :, pt] = Y
            return W.reshape(size, -1) @ V.reshape(size, -1).T
        from scipy.sparse import csr_matrix

        rows = (cam[:, None, None] * _CAM + np.arange(_CAM)[:, None]).repeat(3, axis=2).ravel()
        cols = np.broadcast_to(pt[:, None, None] * 3 + np.arange(3), (len(pt), _CAM, 3)).ravel()
        shape = (size, self.P * 3)
        W_sparse = csr_matrix((Hcp.ravel(), (rows, cols)), shape=shape)
        V_sparse = csr_matrix((Y.ravel(), (rows, cols)), shape=shape)
        return np.asarray((W_sparse @ V_sparse.T).toarray())

    def point_covariance(self, state: _State) -> Floats:
        residual, weight, P = self._residual(state)
        Hpp = self._linearise(state, residual, weight, P)["Hpp"]
        return np.asarray(np.linalg.inv(Hpp + np.eye(3) * 1e-3), dtype=np.float64)


def _damped(H: Floats, damping: float) -> Floats:
    out = H.copy()
    index = np.arange(H.shape[-1])
    out[:, index, index] += damping * H[:, index, index] + 1e-6
    return out


def _runs(sorted_ids: Ints) -> tuple[Ints, Ints]:
    """Starts of runs of equal values, and those values."""
    if len(sorted_ids) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    starts = np.flatnonzero(np.r_[True, sorted_ids[1:] != sorted_ids[:-1]])
    return starts, sorted_ids[starts]


def _solve_positive(S: Floats, rhs: Floats) -> Floats:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        return cho_solve(cho_factor(S, check_finite=False), rhs, check_finite=False)
    except LinAlgError:
        return np.asarray(np.linalg.lstsq(S, rhs, rcond=None)[0], dtype=np.float64)
