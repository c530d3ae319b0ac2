# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt for bundle adjustment, over one set of observations.

The points are eliminated through the Cholesky factor of their blocks: with
``Hpp = C C^T`` and ``Z = Hcp C^-T`` the reduced camera system is ``Hcc - Z Z^T``, one
symmetric product. Arrays are kept by coordinate, ``(3, N)`` and not ``(N, 3)``, because
NumPy is slow at many tiny matrices and fast at a few long rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.backend.point_blocks import inverse_factor, times, times_transposed, transposed_times
from slamdepth.geometry import reprojection_errors, se3_exp
from slamdepth.typing import Bools, Floats

HUBER = 1.5
CAUCHY = 2.0
SCALE_CAUCHY = 2.0
MIN_DEPTH_M = 0.01
_POINT_STEPS = 4
_WORTH = 0.98  # of the cost: steps of points that gain less are not worth their time
_FARTHEST = 10.0  # times its distance: so far a point moves in one step
_CAM = 7  # translation, rotation, log depth scale
_DENSE_LIMIT = 4_000_000  # numbers in the camera-point block before it is kept sparse
_GAIN = 1e-4  # relative fall of the cost below which another step is not worth its time
_SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class State:
    """Poses ``T (K, 4, 4)`` camera from world, points ``X (P, 3)``, log scales ``a (K,)``, readout in s."""

    T: Floats
    X: Floats
    a: Floats
    readout_s: float = 0.0


@dataclass(frozen=True)
class _Border:
    """What the readout time, common to all cameras, adds to the normal equations.

    ``Hrp (3, P)``, ``Hrc (K, 7)``, and the numbers ``Hrr`` and ``br``.
    """

    Hrp: Floats
    Hrc: Floats
    Hrr: float
    br: float


@dataclass(frozen=True)
class _System:
    """The normal equations, by block; ``Hpp (6, P)`` holds the upper triangle."""

    Hpp: Floats
    bp: Floats
    Hcc: Floats
    bc: Floats
    Hcp: Floats
    border: _Border | None = None


class Solver:
    """One phase: which observations count is fixed."""

    def __init__(self, problem: BundleProblem, keep: Bools) -> None:
        self.problem = problem
        index = np.flatnonzero(keep)
        index = index[np.argsort(problem.obs_camera[index], kind="stable")]
        self.cam, self.pt = problem.obs_camera[index], problem.obs_point[index]
        self.px, self.inv_sigma_px = problem.px[index].T.copy(), 1.0 / problem.sigma_px[index]
        self.px_rate = None if problem.px_rate is None else problem.px_rate[index].T.copy()
        has = np.isfinite(problem.log_depth[index])
        self.log_depth = np.where(has, problem.log_depth[index], 0.0)
        self.inv_sigma_log = np.where(has, 1.0 / np.where(has, problem.sigma_log[index], 1.0), 0.0)
        # a fixed pose still has a depth scale of its own to be found
        scaled = np.zeros(len(problem.fixed), dtype=bool)
        if problem.sigma_scale > 0:
            scaled[self.cam[has]] = True
        self._scale_knee = SCALE_CAUCHY * problem.sigma_scale
        self.free = np.flatnonzero(~problem.fixed | scaled)
        self.pinned = problem.fixed[self.free]
        self.P, self.K = len(problem.points_w), len(self.free)
        self._doubts = problem.doubt > 1.0
        self._depth_knee = CAUCHY / problem.doubt
        if self._doubts:
            self._first = np.zeros(self.P, dtype=np.int64)
            self._first[self.pt[::-1]] = self.cam[::-1]
        bounds = np.searchsorted(self.cam, np.arange(len(problem.fixed) + 1)).tolist()
        self.blocks = [slice(bounds[k], bounds[k + 1]) for k in range(len(problem.fixed))]

    def place_points(self, state: State) -> State:
        """Move points only, to where the cameras as they are see them.

        A point that was predicted 3 m away and is not would pull its cameras along in the first common step.
        """
        r, weight, P = self._residual(state)
        cost = self._by_point(self._terms(r))
        for _ in range(_POINT_STEPS):
            before = cost.sum()
            Hpp, bp, *_ = self._point_blocks(state, r, weight, P)
            M = inverse_factor(Hpp, 1e-4)
            X = self._moved(state, -transposed_times(M, times(M, bp)).T)
            cost_new = self._by_point(self._terms(self._residual(replace(state, X=X))[0]))
            better = cost_new < cost
            cost = np.where(better, cost_new, cost)
            state = replace(state, X=np.where(better[:, None], X, state.X))
            if cost.sum() > _WORTH * before:
                break
            r, weight, P = self._residual(state)
        return state

    def run(self, state: State, limit: int) -> tuple[State, float, float, int]:
        """At most ``limit`` steps; returns the state, the cost before and after, the steps taken."""
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
            if gain < _GAIN:
                break
        return state, start, cost, taken

    def _residual(self, state: State) -> tuple[Floats, Floats, Floats]:
        """Whitened residuals ``(3, N)``, robust weights ``(2, N)``, points ``(3, N)`` in the cameras."""
        P = np.ascontiguousarray(state.X[self.pt].T)
        for T, block in zip(state.T, self.blocks, strict=True):
            P[:, block] = T[:3, :3] @ P[:, block] + T[:3, 3:]
        P[2] = np.maximum(P[2], MIN_DEPTH_M)
        r = np.empty_like(P)
        r[:2] = reprojection_errors(self.problem.camera, P, self.px, MIN_DEPTH_M) * self.inv_sigma_px
        if self.px_rate is not None:
            r[:2] -= state.readout_s * self.px_rate * self.inv_sigma_px
        r[2] = (np.log(P[2]) - state.a[self.cam] - self.log_depth) * self.inv_sigma_log
        weight = np.empty((2, P.shape[1]))
        weight[0] = HUBER / np.maximum(np.sqrt(r[0] * r[0] + r[1] * r[1]), HUBER)
        weight[1] = 1.0 / (1.0 + (r[2] / self._depth_knee) ** 2)
        if self._doubts:  # Geman and McClure: what is grossly wrong does not pull
            weight[1] *= weight[1]
        return r, weight, P

    def _cost(self, r: Floats, state: State) -> float:
        pixel, depth = self._pixel_and_depth(r)
        total = float(pixel.sum() + depth.sum())
        if self.problem.sigma_scale > 0:
            total += float(np.sum(SCALE_CAUCHY**2 * np.log1p((state.a / self._scale_knee) ** 2)))
        return total

    def _terms(self, r: Floats) -> Floats:
        """Robust cost ``(N,)`` of each observation."""
        pixel, depth = self._pixel_and_depth(r)
        return pixel + depth

    def _pixel_and_depth(self, r: Floats) -> tuple[Floats, Floats]:
        norm = np.sqrt(r[0] * r[0] + r[1] * r[1])
        pixel = np.where(norm > HUBER, 2 * HUBER * norm - HUBER * HUBER, norm * norm)
        squared = (r[2] / self._depth_knee) ** 2
        if self._doubts:
            return pixel, r[2] ** 2 / (1.0 + squared)
        return pixel, CAUCHY * CAUCHY * np.log1p(squared)

    def _point_blocks(
        self, state: State, r: Floats, weight: Floats, P: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """``Hpp (6, P)``, ``bp (3, P)``; and by observation: derivatives by the point, weighted residuals."""
        camera = self.problem.camera
        root = np.sqrt(weight)
        gain_px, gain_log = root[0] * self.inv_sigma_px, root[1] * self.inv_sigma_log
        inv_z = 1.0 / P[2]
        # residual by the point in the camera frame: the five numbers of each 3 x 3 that are not 0
        A = np.empty((5, P.shape[1]))
        A[0] = camera.fx * inv_z * gain_px
        A[1] = -A[0] * P[0] * inv_z
        A[2] = camera.fy * inv_z * gain_px
        A[3] = -A[2] * P[1] * inv_z
        A[4] = inv_z * gain_log
        b = np.stack([r[0] * root[0], r[1] * root[0], r[2] * root[1]])
        Jp = np.empty((3, 3, P.shape[1]))
        for T, block in zip(state.T, self.blocks, strict=True):
            right, down, forward = T[:3, :3, None]
            Jp[0, :, block] = A[0, block] * right + A[1, block] * forward
            Jp[1, :, block] = A[2, block] * down + A[3, block] * forward
            Jp[2, :, block] = A[4, block] * forward
        Hpp = np.stack([self._by_point((Jp[:, i] * Jp[:, j]).sum(axis=0)) for i, j in _SYMMETRIC])
        bp = np.stack([self._by_point((Jp[:, i] * b).sum(axis=0)) for i in range(3)])
        return Hpp, bp, A, Jp, b

    def _by_point(self, values: Floats) -> Floats:
        """Sums ``(P,)`` over the observations of each point."""
        return np.asarray(np.bincount(self.pt, values, minlength=self.P), dtype=np.float64)

    def _linearise(self, state: State, r: Floats, weight: Floats, P: Floats) -> _System:
        Hpp, bp, A, Jp, b = self._point_blocks(state, r, weight, P)
        x, y, z = P
        sigma_scale = self.problem.sigma_scale
        Jc = np.zeros((_CAM, 3, P.shape[1]))
        Jc[0, 0], Jc[2, 0] = A[0], A[1]
        Jc[1, 1], Jc[2, 1] = A[2], A[3]
        Jc[2, 2] = A[4]
        Jc[3] = Jc[2] * y - Jc[1] * z
        Jc[4] = Jc[0] * z - Jc[2] * x
        Jc[5] = Jc[1] * x - Jc[0] * y
        if sigma_scale > 0:
            Jc[6, 2] = -A[4] * z
        Hcc = np.zeros((self.K, _CAM, _CAM))
        bc = np.zeros((self.K, _CAM))
        Jr = None if self.px_rate is None else -self.px_rate * (np.sqrt(weight[0]) * self.inv_sigma_px)
        Hrc = np.zeros((self.K, _CAM))
        for slot, camera in enumerate(self.free.tolist()):
            block = self.blocks[camera]
            if self.pinned[slot]:
                Jc[:6, :, block] = 0.0
            flat = Jc[:, :, block].reshape(_CAM, -1)
            Hcc[slot] = flat @ flat.T
            bc[slot] = flat @ b[:, block].ravel()
            if Jr is not None:
                Hrc[slot] = np.einsum("irn,rn->i", Jc[:, :2, block], Jr[:, block])
        Hcc[np.flatnonzero(self.pinned)[:, None], np.arange(6), np.arange(6)] += 1.0
        if sigma_scale > 0:
            a = state.a[self.free]
            pull = 1.0 / sigma_scale**2 / (1.0 + (a / self._scale_knee) ** 2)
            Hcc[:, 6, 6] += pull
            bc[:, 6] += a * pull
        else:
            Hcc[:, 6, 6] += 1.0
        border = None
        if Jr is not None:
            Hrp = np.stack([self._by_point((Jp[:2, i] * Jr).sum(axis=0)) for i in range(3)])
            border = _Border(Hrp, Hrc, float((Jr * Jr).sum()), float((Jr * b[:2]).sum()))
        return _System(Hpp, bp, Hcc, bc, np.einsum("irn,rjn->ijn", Jc, Jp), border)

    def _step(self, state: State, system: _System, damping: float) -> State:
        M = inverse_factor(system.Hpp, damping)
        Z = times_transposed(system.Hcp, M[:, self.pt])
        y = times(M, system.bp)
        reduced, rhs = self._reduced(system, Z, y, damping)
        pull = y
        delta_r = 0.0
        if system.border is None:
            delta_c = -_solve_positive(reduced, rhs)
        else:
            w = times(M, system.border.Hrp)
            delta = -_solve_positive(*self._bordered(system.border, reduced, rhs, Z, y, w))
            delta_c, delta_r = delta[:-1], float(delta[-1])
            pull = y + w * delta_r
        delta_c = delta_c.reshape(self.K, _CAM)
        back = np.zeros((3, len(self.pt)))
        for slot, camera in enumerate(self.free.tolist()):
            block = self.blocks[camera]
            back[:, block] = np.einsum("ijn,i->jn", Z[:, :, block], delta_c[slot])
        delta_p = -transposed_times(M, pull + np.stack([self._by_point(row) for row in back]))
        T, a = state.T.copy(), state.a.copy()
        T[self.free] = se3_exp(delta_c[:, :6]) @ T[self.free]
        if self.problem.sigma_scale > 0:
            a[self.free] += delta_c[:, 6]
        return State(T, self._moved(state, delta_p.T), a, state.readout_s + delta_r)

    def _moved(self, state: State, step: Floats) -> Floats:
        """Points ``(P, 3)`` after a step ``(P, 3)``; where depth is doubted, one of inverse distance.

        A distance that was predicted at 3 m and is 300 m is found at once then; in distance itself each step
        at most doubles it (Civera et al., "Inverse depth parametrization for monocular SLAM", 2008).
        """
        if not self._doubts:
            return state.X + step
        T = state.T[self._first]
        offset = state.X + np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
        along = np.einsum("ni,ni->n", step, offset) / np.maximum(np.einsum("ni,ni->n", offset, offset), 1e-12)
        across = step - along[:, None] * offset
        factor = 1.0 / np.maximum(1.0 - along, 1.0 / _FARTHEST)
        return np.asarray(state.X - offset + factor[:, None] * (offset + across))

    def _reduced(self, system: _System, Z: Floats, y: Floats, damping: float) -> tuple[Floats, Floats]:
        """The camera system ``(7 K, 7 K)``, ``(7 K,)`` that is left when the points are eliminated."""
        S, rhs = np.zeros((self.K, _CAM, self.K, _CAM)), system.bc.copy()
        damped = system.Hcc.copy()
        diagonal = np.arange(_CAM)
        damped[:, diagonal, diagonal] += damping * system.Hcc[:, diagonal, diagonal] + 1e-6
        each = np.arange(self.K)
        S[each, :, each] = damped
        rhs -= self._seen_by_cameras(Z, y)
        size = self.K * _CAM
        return S.reshape(size, size) - self._coupling(Z), rhs.ravel()

    def _bordered(
        self, border: _Border, reduced: Floats, rhs: Floats, Z: Floats, y: Floats, w: Floats
    ) -> tuple[Floats, Floats]:
        """The same with the readout time as last row and column; ``w (3, P)`` is its eliminated part."""
        column = (border.Hrc - self._seen_by_cameras(Z, w)).ravel()
        corner = border.Hrr - float((w * w).sum()) + 1e-6
        S = np.block([[reduced, column[:, None]], [column[None], np.array([[corner]])]])
        return S, np.append(rhs, border.br - float((w * y).sum()))

    def _seen_by_cameras(self, Z: Floats, v: Floats) -> Floats:
        """``Z v`` for a value ``(3, P)`` of each point, ``(K, 7)``."""
        seen = v[:, self.pt]
        out = np.zeros((self.K, _CAM))
        for slot, camera in enumerate(self.free.tolist()):
            block = self.blocks[camera]
            out[slot] = np.einsum("ijn,jn->i", Z[:, :, block], seen[:, block])
        return out

    def readout_sigma_s(self, state: State) -> float:
        """Deviation of the readout time, all poses and points being free."""
        system = self._linearise(state, *self._residual(state))
        assert system.border is not None
        M = inverse_factor(system.Hpp, 0.0)
        Z = times_transposed(system.Hcp, M[:, self.pt])
        y = np.zeros((3, self.P))
        reduced, rhs = self._reduced(system, Z, y, 0.0)
        S, _ = self._bordered(system.border, reduced, rhs, Z, y, times(M, system.border.Hrp))
        unit = np.zeros(len(S))
        unit[-1] = 1.0
        return float(np.sqrt(max(_solve_positive(S, unit)[-1], 0.0)))

    def _coupling(self, Z: Floats) -> Floats:
        """``Z Z^T`` over all points, ``(7 K, 7 K)``."""
        size = self.K * _CAM
        if size * self.P * 3 <= _DENSE_LIMIT:
            # a pinned camera moves only its depth scale: its other rows are 0 and not worth the product
            first = np.where(self.pinned, _CAM - 1, 0)
            rows = np.flatnonzero(np.arange(_CAM) >= first[:, None])
            ends = np.cumsum(_CAM - first)
            dense = np.zeros((len(rows), 3, self.P))
            for slot, camera in enumerate(self.free.tolist()):
                block = self.blocks[camera]
                own = Z[first[slot] :, :, block]
                dense[ends[slot] - len(own) : ends[slot]][:, :, self.pt[block]] = own
            flat = dense.reshape(len(rows), 3 * self.P)
            coupling = np.zeros((size, size))
            coupling[np.ix_(rows, rows)] = flat @ flat.T
            return coupling
        from scipy.sparse import bsr_matrix

        blocks = [self.blocks[camera] for camera in self.free.tolist()]
        seen = np.concatenate([np.arange(block.start, block.stop) for block in blocks])
        counts = [block.stop - block.start for block in blocks]
        sparse = bsr_matrix(
            (
                np.ascontiguousarray(Z[:, :, seen].transpose(2, 0, 1)),
                self.pt[seen],
                np.concatenate([[0], np.cumsum(counts)]),
            ),
            shape=(size, 3 * self.P),
        )
        return np.asarray((sparse @ sparse.T).toarray())

    def point_covariance(self, state: State) -> Floats:
        """Covariance ``(P, 3, 3)`` in square metres of each point, given the poses."""
        Hpp = self._point_blocks(state, *self._residual(state))[0]
        full = np.empty((self.P, 3, 3))
        for row, (i, j) in zip(Hpp, _SYMMETRIC, strict=True):
            full[:, i, j] = full[:, j, i] = row
        return np.asarray(np.linalg.inv(full + np.eye(3) * 1e-3), dtype=np.float64)


def _solve_positive(S: Floats, rhs: Floats) -> Floats:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        return np.asarray(cho_solve(cho_factor(S, check_finite=False), rhs, check_finite=False))
    except LinAlgError:
        return np.asarray(np.linalg.lstsq(S, rhs, rcond=None)[0], dtype=np.float64)
