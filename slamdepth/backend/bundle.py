# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of keyframes, points and the depth scale of each keyframe.

Minimises, over poses, points and one log scale ``a_k`` per keyframe,

    sum  rho(|pi(T_k X_p) - u_kp|^2 / s_kp^2)              reprojection, Huber
       + sum  rho_c((log z_kp - a_k - log d_kp)^2 / t_kp^2)   depth prior, Cauchy
       + sum  rho_c(a_k^2 / s_a^2)                            a keyframe's common depth error, Cauchy

and, where the shutter may roll, over the readout time ``r`` common to all images, which
moves a pixel ``u`` by ``r du/dr`` (``BundleProblem.px_rate``);
by Levenberg-Marquardt with the points eliminated (Schur complement; Triggs et al.,
"Bundle Adjustment: A Modern Synthesis", 1999). A predicted depth errs mostly in
common over a whole image, which is what ``a_k`` takes up: without it a hundred pixels
of one prediction would count as a hundred independent measurements.

This is our own solver and not a GTSAM graph because building a graph in Python costs
as much as solving it; whole arrays in NumPy do both several times faster. A test
compares the two.
"""

from __future__ import annotations

import numpy as np

from slamdepth.backend.bundle_problem import BundleProblem, BundleResult
from slamdepth.backend.bundle_solver import Solver
from slamdepth.backend.sightings import Sightings, State
from slamdepth.geometry import CHI2_2DOF_95
from slamdepth.typing import Floats

_CONVERGED = 1e-3  # relative fall of the cost; what is left moves cameras by a fraction of their deviation
_ROUGHLY_CONVERGED = 1e-2  # enough to tell outliers


def bundle_adjust(
    problem: BundleProblem, iterations: tuple[int, ...] = (4, 6), gate: float = CHI2_2DOF_95
) -> BundleResult:
    """Adjust ``problem``; after each phase but the last, outlying observations are set aside.

    Args:
        iterations: Levenberg-Marquardt steps at most, per phase.
        gate: squared whitened residual beyond which an observation is an outlier.
    """
    state = State(
        problem.T_camera_world.copy(), problem.points_w.copy(), np.zeros(len(problem.T_camera_world))
    )
    every = Sightings(problem)
    first_cost: float | None = None
    cost = 0.0
    steps = 0
    solver = Solver(problem, every)
    if problem.doubt > 1.0:
        state = solver.place_points(state)
    for phase, limit in enumerate(iterations):
        if phase:
            solver = Solver(problem, every.where(_pixel_chi2(every, state) < gate))
        is_last = phase == len(iterations) - 1
        state, start, cost, taken = solver.run(state, limit, _CONVERGED if is_last else _ROUGHLY_CONVERGED)
        first_cost = start if first_cost is None else first_cost
        steps += taken
    chi2 = _pixel_chi2(every, state)
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
        readout_s=state.readout_s,
        readout_sigma_s=None if problem.px_rate is None else solver.readout_sigma_s(state),
    )


def _pixel_chi2(every: Sightings, state: State) -> Floats:
    """Squared whitened pixel residuals ``(M,)`` of all observations, in the order of the problem."""
    chi2 = np.empty(len(every))
    chi2[every.index] = every.pixel_chi2(state)
    return chi2
