# SPDX-License-Identifier: Apache-2.0
"""Observations of a bundle adjustment by camera and coordinate, and how far they are off.

Arrays are ``(3, N)`` and not ``(N, 3)``: NumPy is slow at many tiny matrices and fast at a few long rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.geometry import reprojection_errors
from slamdepth.typing import Bools, Floats, Ints

HUBER = 1.5
CAUCHY = 2.0
MIN_DEPTH_M = 0.01


@dataclass(frozen=True)
class State:
    """Poses ``T (K, 4, 4)`` camera from world, points ``X (P, 3)``, log scales ``a (K,)``, readout in s."""

    T: Floats
    X: Floats
    a: Floats
    readout_s: float = 0.0


@dataclass(frozen=True)
class Seen:
    """``N`` observations of a state.

    Attributes:
        P: ``(3, N)`` the point in the camera frame, at least ``MIN_DEPTH_M`` away.
        r: ``(3, N)`` whitened residuals: pixel and log depth.
        weight: ``(2, N)`` robust weights of pixel and depth.
        terms: ``(N,)`` robust cost of each.
    """

    P: Floats
    r: Floats
    weight: Floats
    terms: Floats


class Sightings:
    """Observations ordered by camera: first those of cameras that may move, then those of fixed ones.

    Attributes:
        index: ``(N,)`` of each in the problem; pt: ``(N,)`` point of each.
        cameras: ``(K,)`` in this order; the place of a camera in it is its slot.
        free: number of cameras that may move.
        counts: ``(K,)`` observations of each slot; ends: ``(K + 1,)`` where those of each begin and end.
        inv_sigma_px: ``(N,)``; inv_sigma_log: ``(N,)``, 0 where there is no depth.
        px_rate: ``(2, N)`` see :class:`BundleProblem`, or None.
    """

    def __init__(self, problem: BundleProblem, index: Ints | None = None) -> None:
        self._problem = problem
        self.cameras = np.argsort(problem.fixed, kind="stable")
        self.free = int(np.count_nonzero(~problem.fixed))
        slot = np.empty_like(self.cameras)
        slot[self.cameras] = np.arange(len(slot))
        if index is None:
            index = np.argsort(slot[problem.obs_camera], kind="stable")
        self.index = index
        self.pt = problem.obs_point[index]
        self.counts = np.bincount(slot[problem.obs_camera[index]], minlength=len(slot))
        self.ends = np.concatenate([[0], np.cumsum(self.counts)])
        self._px = np.ascontiguousarray(problem.px[index].T)
        self.inv_sigma_px = 1.0 / problem.sigma_px[index]
        self.px_rate = None if problem.px_rate is None else np.ascontiguousarray(problem.px_rate[index].T)
        log_depth = problem.log_depth[index]
        has = np.isfinite(log_depth)
        self._log_depth = np.where(has, log_depth, 0.0)
        self.inv_sigma_log = np.where(has, 1.0 / np.where(has, problem.sigma_log[index], 1.0), 0.0)
        self._doubts = problem.doubt > 1.0
        self._depth_knee = CAUCHY / problem.doubt

    def __len__(self) -> int:
        return len(self.index)

    def where(self, keep: Bools) -> Sightings:
        """Those of the problem's observations that ``keep (M,)`` says."""
        return self if keep.all() else Sightings(self._problem, self.index[keep[self.index]])

    def block(self, slot: int) -> slice:
        """The observations of one camera."""
        return slice(int(self.ends[slot]), int(self.ends[slot + 1]))

    @property
    def moving(self) -> int:
        """Number of observations, the first ones, of cameras that may move."""
        return int(self.ends[self.free])

    def by_point(self, values: Floats) -> Floats:
        """Sums ``(P,)`` of ``values (N,)``, or of the first ones, over the observations of each point."""
        sums = np.bincount(self.pt[: len(values)], values, minlength=len(self._problem.points_w))
        return np.asarray(sums, dtype=np.float64)

    def by_slot(self, values: Floats) -> Floats:
        """Sums ``(K, R)`` of ``values (R, N)``, or of the first ones, over the observations of each slot."""
        out = np.zeros((len(self.counts), len(values)))
        seeing = np.flatnonzero((self.counts > 0) & (self.ends[:-1] < values.shape[1]))
        if len(seeing):
            out[seeing] = np.add.reduceat(values, self.ends[seeing], axis=1).T
        return out

    def each(self, of_slot: Floats) -> Floats:
        """``(R, N)``: the values ``(S, R)`` of the slot of each observation of the first ``S`` slots."""
        counts = self.counts[: len(of_slot)]
        return np.asarray(np.repeat(np.ascontiguousarray(of_slot.T), counts, axis=1), dtype=np.float64)

    def rotations(self, state: State) -> Floats:
        """``(3, 3, N)`` of the camera of each observation."""
        return self.each(state.T[self.cameras, :3, :3].reshape(-1, 9)).reshape(3, 3, -1)

    def look(self, state: State) -> Seen:
        """The observations as ``state`` predicts them."""
        camera = self._problem.camera
        T = self.each(state.T[self.cameras, :3].reshape(-1, 12)).reshape(3, 4, -1)
        X = np.ascontiguousarray(state.X.T).take(self.pt, axis=1)
        P = np.empty_like(X)
        for row, (right, down, forward, t) in zip(P, T, strict=True):
            np.multiply(right, X[0], out=row)
            row += down * X[1]
            row += forward * X[2]
            row += t
        np.maximum(P[2], MIN_DEPTH_M, out=P[2])
        r = np.empty_like(P)
        r[:2] = reprojection_errors(camera, P, self._px, MIN_DEPTH_M)
        if self.px_rate is not None:
            r[:2] -= state.readout_s * self.px_rate
        r[:2] *= self.inv_sigma_px
        scale = np.repeat(state.a[self.cameras], self.counts)
        r[2] = (np.log(P[2]) - scale - self._log_depth) * self.inv_sigma_log
        squared = r[0] * r[0] + r[1] * r[1]
        weight = np.empty((2, len(squared)))
        weight[0] = HUBER / np.maximum(np.sqrt(squared), HUBER)
        terms = squared * weight[0] * (2.0 - weight[0])
        knee = 1.0 + (r[2] / self._depth_knee) ** 2
        weight[1] = 1.0 / knee
        if self._doubts:  # Geman and McClure: what is grossly wrong does not pull
            terms += r[2] * r[2] * weight[1]
            weight[1] *= weight[1]
        else:
            terms += CAUCHY * CAUCHY * np.log(knee)
        return Seen(P, r, weight, terms)

    def pixel_chi2(self, state: State) -> Floats:
        """Squared whitened pixel residuals ``(N,)``, infinite for points that are not before the camera."""
        seen = self.look(state)
        chi2 = seen.r[0] ** 2 + seen.r[1] ** 2
        return np.where(seen.P[2] > MIN_DEPTH_M, chi2, np.inf)
