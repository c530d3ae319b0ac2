# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt for bundle adjustment, over one set of observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.backend.camera_system import CameraSystem
from slamdepth.backend.elimination import Eliminated
from slamdepth.backend.normal_equations import System, linearise, point_system
from slamdepth.backend.point_blocks import inverse, inverse_factor, times, transposed_times
from slamdepth.backend.sightings import Seen, Sightings, State
from slamdepth.geometry import se3_exp
from slamdepth.typing import Floats

SCALE_CAUCHY = 2.0
_POINT_STEPS = 4
_WORTH = 0.98  # of the cost: steps of points that gain less are not worth their time
_FARTHEST = 10.0  # times its distance: so far a point moves in one step


class Solver:
    """One phase: which observations count is fixed."""

    def __init__(self, problem: BundleProblem, sightings: Sightings) -> None:
        self._problem = problem
        self._sightings = sightings
        self._with_scale = problem.sigma_scale > 0
        # a fixed pose still has a depth scale of its own to be found
        scaled = np.zeros(len(problem.fixed), dtype=bool)
        if self._with_scale:
            scaled = sightings.by_slot(sightings.inv_sigma_log[None])[:, 0] > 0.0
            scaled[: sightings.free] = True
        self._scale_knee = SCALE_CAUCHY * problem.sigma_scale
        self._cameras = CameraSystem(sightings, len(problem.points_w), scaled)
        self._doubts = problem.doubt > 1.0
        if self._doubts:
            self._first = np.zeros(len(problem.points_w), dtype=np.int64)
            index = sightings.index
            index = index[np.argsort(-problem.obs_camera[index], kind="stable")]
            self._first[problem.obs_point[index]] = problem.obs_camera[index]

    def place_points(self, state: State) -> State:
        """Move points only, to where the cameras as they are see them.

        A point that was predicted 3 m away and is not would pull its cameras along in the first common step.
        """
        by_point = self._sightings.by_point
        seen = self._sightings.look(state)
        cost = by_point(seen.terms)
        for _ in range(_POINT_STEPS):
            before = cost.sum()
            Hpp, bp = point_system(self._problem.camera, self._sightings, state, seen)
            M = inverse_factor(Hpp, 1e-4)
            X = self._moved(state, -transposed_times(M, times(M, bp)).T)
            cost_new = by_point(self._sightings.look(replace(state, X=X)).terms)
            better = cost_new < cost
            cost = np.where(better, cost_new, cost)
            state = replace(state, X=np.where(better[:, None], X, state.X))
            if cost.sum() > _WORTH * before:
                break
            seen = self._sightings.look(state)
        return state

    def run(self, state: State, limit: int, least_gain: float) -> tuple[State, float, float, int]:
        """At most ``limit`` steps; returns the state, the cost before and after, the steps taken.

        Args:
            least_gain: relative fall of the cost below which another step is not worth its time.
        """
        seen = self._sightings.look(state)
        cost = start = self._cost(seen, state)
        damping = 1e-4
        taken = 0
        for _ in range(limit):
            taken += 1
            system = linearise(self._problem.camera, self._sightings, state, seen)
            improved = False
            for _ in range(4):
                candidate = self._step(state, system, damping)
                new_seen = self._sightings.look(candidate)
                new_cost = self._cost(new_seen, candidate)
                if np.isfinite(new_cost) and new_cost < cost:
                    improved = True
                    break
                damping = min(damping * 10.0, 1e6)
            if not improved:
                break
            gain = (cost - new_cost) / max(cost, 1e-12)
            state, seen, cost = candidate, new_seen, new_cost
            damping = max(damping * 0.2, 1e-8)
            if gain < least_gain:
                break
        return state, start, cost, taken

    def _cost(self, seen: Seen, state: State) -> float:
        total = float(seen.terms.sum())
        if self._with_scale:
            total += float(np.sum(SCALE_CAUCHY**2 * np.log1p((state.a / self._scale_knee) ** 2)))
        return total

    def _step(self, state: State, system: System, damping: float) -> State:
        cameras = self._sightings.cameras
        pull, gradient = self._scale_prior(state)
        step = Eliminated(self._sightings, self._cameras, system, pull, damping).step(gradient)
        T, a = state.T.copy(), state.a.copy()
        T[cameras] = se3_exp(step.cameras[:, :6]) @ T[cameras]
        a[cameras] += step.cameras[:, 6]
        return State(T, self._moved(state, step.points.T), a, state.readout_s + step.readout_s)

    def _scale_prior(self, state: State) -> tuple[Floats, Floats]:
        """Information on the log depth scales and gradient of their cost, ``(K,)`` each by slot."""
        a = state.a[self._sightings.cameras]
        if not self._with_scale:
            return np.zeros_like(a), a
        pull = 1.0 / self._problem.sigma_scale**2 / (1.0 + (a / self._scale_knee) ** 2)
        return pull, a * pull

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

    def readout_sigma_s(self, state: State) -> float:
        """Deviation of the readout time, all poses and points being free."""
        system = linearise(self._problem.camera, self._sightings, state, self._sightings.look(state))
        pull, _ = self._scale_prior(state)
        return float(
            np.sqrt(Eliminated(self._sightings, self._cameras, system, pull, 0.0).readout_variance())
        )

    def point_covariance(self, state: State) -> Floats:
        """Covariance ``(P, 3, 3)`` in square metres of each point, given the poses."""
        Hpp, _ = point_system(self._problem.camera, self._sightings, state, self._sightings.look(state))
        Hpp[[0, 3, 5]] += 1e-3
        return inverse(Hpp)
