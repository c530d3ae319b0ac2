# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: focal length and radial distortion as unknowns of a bundle adjustment.

Minimises, over poses, points and the unknowns ``theta`` that all images share,

    sum  rho(|pi(T_k X_p; theta) - u_kp - r du_kp/dr|^2 / s_kp^2)  +  sum (theta_i - mean_i)^2 / sigma_i^2

with Huber's ``rho`` and ``pi(X, Y, Z) = c + f (1 + k1 q + k2 q^2) (X/Z, Y/Z)``, ``q = (X^2 + Y^2) / Z^2``.
``theta`` is log f, k1, k2, the centre ``c`` and a change of the shutter's readout time ``r``. There is no
depth prior: predicted depth goes with the focal length that it was predicted for.

The deviations come from the residuals' own size, grouped (a "sandwich", Huber 1967; clusters as in Liang and
Zeger 1986): the errors of one landmark in successive images, and those of one image, are not independent, and
a bundle adjustment that takes them so is too sure by a factor of several.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamdepth.backend.self_calibration_system import System
from slamdepth.backend.sights import Lens, Seen, Sights
from slamdepth.geometry import CHI2_2DOF_99, se3_exp
from slamdepth.thread_limits import single_threaded
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats

_HUBER = 1.5
_LEAST_SIZE = 1e-3
_CONVERGED = 1e-6  # relative fall of the cost: f and the distances of points lie along a valley
_MAX_LOG_F_STEP = 0.2
_FARTHEST = 10.0  # times its distance: so far a point moves in one step


@dataclass(frozen=True)
class Prior:
    """What is known of the unknowns before the motion is looked at.

    Attributes:
        focal_px: the focal length that is expected.
        sigma_log_f: deviation of its logarithm.
        k1, k2: deviations of the radial coefficients about 0; 0 keeps one as it is.
        centre: deviation of the centre about the middle of the image, as a share of the longer side; 0 keeps
            it.
        readout_s: deviation of the readout time about what it is taken for; 0 keeps it.
    """

    focal_px: float
    sigma_log_f: float
    k1: float = 0.15
    k2: float = 0.15
    centre: float = 0.01
    readout_s: float = 0.0


@dataclass(frozen=True)
class SelfCalibration:
    """A camera as the motion shows it.

    Attributes:
        camera: with the focal length, distortion and centre that were found.
        sigma_log_f: deviation of the logarithm of the focal length, of errors in groups, see this module.
        sigma_k1: deviation of the first radial coefficient.
        naive_sigma_log_f: the same if every residual were independent and as large as it claims.
        readout_s: change of the readout time.
        sigma_px: root mean square of the whitened residuals per coordinate.
        observations: number of observations that agree.
        converged: whether the adjustment came to rest.
    """

    camera: Camera
    sigma_log_f: float
    sigma_k1: float
    naive_sigma_log_f: float
    readout_s: float
    sigma_px: float
    observations: int
    converged: bool


def self_calibrate(sights: Sights, camera: Camera, prior: Prior, iterations: int = 40) -> SelfCalibration:
    """Find the camera that took images whose poses and points are roughly known.

    Args:
        camera: a first guess; of its distortion k1 and k2 alone are used.
        iterations: steps at most, before and after outliers are set aside, each.
    """
    with single_threaded():
        every = np.ones(len(sights.obs_camera), dtype=bool)
        solver = _Solver(sights, camera, prior)
        state, _ = solver.run(solver.start(), every, iterations)
        # the residuals' own size, which is about half of what the keypoints claim, tells outliers
        size = max(_size(solver.look(state)), _LEAST_SIZE)
        solver = _Solver(replace(sights, sigma_px=size * sights.sigma_px), camera, prior)
        keep = solver.look(state).chi2 < CHI2_2DOF_99
        state, converged = solver.run(state, keep, iterations)
        return solver.result(state, keep, size, converged)


def _size(seen: Seen) -> float:
    """Robust size of the whitened residuals of a coordinate."""
    return float(np.sqrt(np.median(seen.chi2) / (2.0 * np.log(2.0))))


@dataclass(frozen=True)
class _State:
    T: Floats
    X: Floats
    lens: Lens


class _Solver:
    """Levenberg-Marquardt over one set of observations."""

    def __init__(self, sights: Sights, camera: Camera, prior: Prior) -> None:
        self._sights, self._camera = sights, camera
        centre_px = prior.centre * max(camera.width, camera.height)
        sigma = np.array(
            [prior.sigma_log_f, prior.k1, prior.k2, centre_px, centre_px, prior.readout_s], dtype=np.float64
        )
        self._free = np.flatnonzero(sigma > 0)
        self._pull = 1.0 / sigma[self._free] ** 2
        middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
        self._mean = np.array([np.log(prior.focal_px), 0.0, 0.0, *middle, 0.0])
        # one image of each map holds its world frame
        self._moving = np.ones(len(sights.T_camera_world), dtype=bool)
        self._moving[np.unique(sights.group, return_index=True)[1]] = False
        self._first = np.zeros(len(sights.points_w), dtype=np.int64)
        self._first[sights.obs_point[::-1]] = sights.obs_camera[::-1]

    def start(self) -> _State:
        camera, sights = self._camera, self._sights
        theta = np.array([np.log(camera.fx), *camera.distortion[:2], camera.cx, camera.cy, 0.0])
        return _State(sights.T_camera_world, sights.points_w, Lens(theta, camera.fy / camera.fx))

    def look(self, state: _State) -> Seen:
        return state.lens.look(self._sights, state.T, state.X)

    def run(self, state: _State, keep: Bools, limit: int) -> tuple[_State, bool]:
        """At most ``limit`` steps; returns the state, and whether it came to rest."""
        damping, cost = 1e-4, self._cost(state, keep)
        for _ in range(limit):
            system = self._system(state, keep)
            for _ in range(6):
                try:
                    candidate = self._moved(state, system, damping)
                    new = self._cost(candidate, keep)
                except np.linalg.LinAlgError:  # the equations are singular at this damping
                    new = np.inf
                if np.isfinite(new) and new < cost:
                    break
                damping *= 10.0
            else:
                return state, True
            gain, state, cost = (cost - new) / max(cost, 1e-12), candidate, new
            damping = max(damping * 0.2, 1e-9)
            if gain < _CONVERGED:
                return state, True
        return state, False

    def result(self, state: _State, keep: Bools, size: float, converged: bool) -> SelfCalibration:
        deviations = np.zeros((2, len(self._mean)))
        for row, covariance in zip(deviations, self._system(state, keep).covariances(), strict=True):
            row[self._free] = np.sqrt(np.diag(covariance))
        log_f, k1, k2, cx, cy, readout_s = (float(value) for value in state.lens.theta)
        f = float(np.exp(log_f))
        camera = replace(
            self._camera, fx=f, fy=f * state.lens.aspect, cx=cx, cy=cy, distortion=(k1, k2, 0.0, 0.0, 0.0)
        )
        return SelfCalibration(
            camera,
            sigma_log_f=float(deviations[0, 0]),
            sigma_k1=float(deviations[0, 1]),
            naive_sigma_log_f=float(deviations[1, 0]),
            readout_s=readout_s,
            sigma_px=size,
            observations=int(np.count_nonzero(keep)),
            converged=converged,
        )

    def _cost(self, state: _State, keep: Bools) -> float:
        norm = np.sqrt(self.look(state).chi2[keep])
        weight = _HUBER / np.maximum(norm, _HUBER)
        off = self._off(state)
        return float((norm**2 * weight * (2.0 - weight)).sum() + (self._pull * off**2).sum())

    def _off(self, state: _State) -> Floats:
        return np.asarray((state.lens.theta - self._mean)[self._free])

    def _system(self, state: _State, keep: Bools) -> System:
        seen = self.look(state)
        weight = np.sqrt(_HUBER / np.maximum(np.sqrt(seen.chi2), _HUBER))
        gradient = self._pull * self._off(state)
        return System(
            self._sights, seen, keep, state.T[:, :3, :3], self._moving, state.lens, self._free, self._pull,
            gradient, weight,
        )  # fmt: skip

    def _moved(self, state: _State, system: System, damping: float) -> _State:
        """The state after a step, which is shortened where the focal length would leap.

        The step of a point is one of inverse distance from the first image that sees it. Far points are
        found at once then, whose distance would at most double in each step (Civera et al. 2008); without it
        the adjustment creeps along the valley of focal length and distance.
        """
        step = system.step(damping)
        share = min(1.0, _MAX_LOG_F_STEP / max(abs(float(step.shared[0])), 1e-12))
        T = state.T.copy()
        T[self._moving] = se3_exp(share * step.images) @ T[self._moving]
        theta = state.lens.theta.copy()
        theta[self._free] += share * step.shared
        first = state.T[self._first]
        offset = state.X + np.einsum("nji,nj->ni", first[:, :3, :3], first[:, :3, 3])
        points = share * step.points
        along = np.einsum("ni,ni->n", points, offset) / np.maximum((offset * offset).sum(axis=1), 1e-12)
        across = points - along[:, None] * offset
        factor = 1.0 / np.maximum(1.0 - along, 1.0 / _FARTHEST)
        X = state.X - offset + factor[:, None] * (offset + across)
        return _State(T, X, Lens(theta, state.lens.aspect))
