# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of intrinsics and of the poses of a flat board (Zhang 2000), with deviations.

Levenberg-Marquardt; the poses are eliminated from the normal equations. Huber's weights keep a wrongly
detected corner from mattering.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.boards.board import Board, Sighting
from slamdepth.boards.lens import LensModel
from slamdepth.boards.start import first_guess, residuals
from slamdepth.geometry import se3_exp
from slamdepth.robust import robust_deviation
from slamdepth.typing import Bools, Floats

_ITERATIONS, _ROUNDS = 60, 3
_HUBER = 2.0
_SMALL_GAIN = 1e-9
_NOTHING_LEFT = 1e-12
"""Share of a direction of the normal equations that is rounding alone."""


@dataclass(frozen=True)
class Fit:
    """Intrinsics that images of a board determine.

    Attributes:
        model: the lens model.
        values: ``(4 + k,)`` intrinsics, named by ``model.names``.
        sigma: ``(4 + k,)`` standard deviations.
        covariance: ``(4 + k, 4 + k)`` of ``values``.
        T_camera_board: pose of the board in each image, millimetres.
        errors_px: residuals ``(N, 2)`` of each image.
        rms_px: root mean square distance of a corner from its projection.
    """

    model: LensModel
    values: Floats
    sigma: Floats
    covariance: Floats
    T_camera_board: tuple[Floats, ...]
    errors_px: tuple[Floats, ...]
    rms_px: float

    @property
    def view_rms_px(self) -> Floats:
        """``(V,)`` root mean square distance of each image."""
        return np.array([_rms(errors) for errors in self.errors_px])

    @property
    def tilts_deg(self) -> Floats:
        """``(V,)`` angle between the board's normal and the optical axis."""
        cosines = [abs(T[2, 2]) for T in self.T_camera_board]
        return np.asarray(np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))))


def fit_board(model: LensModel, board: Board, sightings: Sequence[Sighting], size: tuple[int, int]) -> Fit:
    """The intrinsics that fit ``sightings`` best.

    Args:
        size: width and height of the images.
    """
    values, poses = first_guess(model, board, sightings, size)
    free = np.arange(len(values)) <= 4  # first with one coefficient: all of them run away from a poor start
    problem = _Problem(model, board, sightings)
    values, poses = problem.solve(values, poses, free)
    free = np.ones(len(values), bool)
    values, poses = problem.solve(values, poses, free)
    covariance = problem.covariance(values, poses, free)
    errors = tuple(residuals(model, values, board, seen, T) for seen, T in zip(sightings, poses, strict=True))
    return Fit(
        model, values, np.sqrt(np.diag(covariance)), covariance, tuple(poses), errors,
        _rms(np.concatenate(errors)),
    )  # fmt: skip


def _rms(errors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


class _Problem:
    def __init__(self, model: LensModel, board: Board, sightings: Sequence[Sighting]) -> None:
        self._model = model
        self._points = [board.corners_mm[sighting.ids] for sighting in sightings]
        self._px = np.concatenate([sighting.px for sighting in sightings])
        ends = np.cumsum([len(points) for points in self._points])
        self._parts = [slice(end - len(p), end) for end, p in zip(ends, self._points, strict=True)]

    def solve(self, values: Floats, poses: list[Floats], free: Bools) -> tuple[Floats, list[Floats]]:
        for _ in range(_ROUNDS):
            scale = max(1e-4, robust_deviation(self._errors(values, poses).ravel(), 0.0))
            values, poses = self._settle(values, poses, free, scale)
        return values, poses

    def _settle(
        self, values: Floats, poses: list[Floats], free: Bools, scale: float
    ) -> tuple[Floats, list[Floats]]:
        damping, cost = 1e-3, self._cost(values, poses, scale)
        for _ in range(_ITERATIONS):
            system = self._system(values, poses, free, scale)
            gain = 0.0
            while damping < 1e8:
                step, pose_steps = _solve(*system, damping)
                new_values = values.copy()
                new_values[free] += step
                new_poses = [se3_exp(d) @ T for d, T in zip(pose_steps, poses, strict=True)]
                new_cost = self._cost(new_values, new_poses, scale)
                if new_values[:2].min() > 0 and new_cost < cost:
                    gain = (cost - new_cost) / cost
                    values, poses, cost, damping = new_values, new_poses, new_cost, damping / 5.0
                    break
                damping *= 4.0
            if gain < _SMALL_GAIN:
                break
        return values, poses

    def covariance(self, values: Floats, poses: list[Floats], free: Bools) -> Floats:
        """Covariance ``(P, P)`` of the intrinsics.

        The larger of two: by the size of all residuals, and by how much the views pull apart (the sandwich
        estimator over views), since errors within a view are alike.
        """
        errors = self._errors(values, poses)
        scale = max(1e-4, robust_deviation(errors.ravel(), 0.0))
        A, B, C, a, c = self._system(values, poses, free, scale)
        reduced, scores = np.zeros_like(A[0]), []
        for A_v, B_v, C_v, a_v, c_v in zip(A, B, C, a, c, strict=True):
            gain = np.linalg.solve(C_v, B_v.T).T
            reduced += A_v - gain @ B_v.T
            scores.append(a_v - gain @ c_v)
        views, unknowns = len(scores), int(free.sum()) + 6 * len(scores)
        inverse = _inverse(reduced, np.sum(A, axis=0))
        weights = self._weights(errors, scale)
        variance = float(np.sum(weights[:, None] * errors**2)) / max(1, 2 * len(errors) - unknowns)
        of_all = variance * inverse
        apart = np.array(scores)
        of_views = inverse @ (apart.T @ apart) @ inverse * views / max(1, views - 1)
        growth = np.sqrt(np.maximum(1.0, np.diag(of_views) / np.maximum(np.diag(of_all), 1e-300)))
        full = np.zeros((len(values), len(values)))
        full[np.ix_(free, free)] = of_all * np.outer(growth, growth)
        return full

    def _points_c(self, poses: list[Floats]) -> Floats:
        moved = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(self._points, poses, strict=True)]
        return np.concatenate(moved)

    def _errors(self, values: Floats, poses: list[Floats]) -> Floats:
        return np.asarray(self._model.project(values, self._points_c(poses)) - self._px)

    def _cost(self, values: Floats, poses: list[Floats], scale: float) -> float:
        size = np.linalg.norm(self._errors(values, poses), axis=1) / scale
        cost = np.where(size <= _HUBER, 0.5 * size**2, _HUBER * (size - 0.5 * _HUBER)).sum()
        return float(cost) if np.isfinite(cost) else np.inf

    def _weights(self, errors: Floats, scale: float) -> Floats:
        size = np.linalg.norm(errors, axis=1) / scale
        return np.asarray(_HUBER / np.maximum(size, _HUBER))

    def _system(
        self, values: Floats, poses: list[Floats], free: Bools, scale: float
    ) -> tuple[list[Floats], list[Floats], list[Floats], list[Floats], list[Floats]]:
        """Normal equations of each view: intrinsics, intrinsics by pose, pose, and both gradients."""
        points_c = self._points_c(poses)
        errors = self._model.project(values, points_c) - self._px
        by_values = self._by_values(values, points_c)[:, :, free]
        by_pose = self._by_pose(values, points_c)
        weights = self._weights(errors, scale)
        systems: tuple[list[Floats], ...] = ([], [], [], [], [])
        for part in self._parts:
            J, K = by_values[part].reshape(-1, int(free.sum())), by_pose[part].reshape(-1, 6)
            w = np.repeat(weights[part], 2)[:, None]
            r = errors[part].ravel()
            wr = w[:, 0] * r
            of_view = J.T @ (w * J), J.T @ (w * K), K.T @ (w * K), J.T @ wr, K.T @ wr
            for into, what in zip(systems, of_view, strict=True):
                into.append(what)
        A, B, C, a, c = systems
        return A, B, C, a, c

    def _by_values(self, values: Floats, points_c: Floats) -> Floats:
        """``(N, 2, P)`` derivatives by the intrinsics, by central differences."""
        columns = []
        for index in range(len(values)):
            step = 1e-6 * max(1.0, abs(values[index]))
            there = np.where(np.arange(len(values)) == index, step, 0.0)
            ahead, behind = (self._model.project(values + s * there, points_c) for s in (1, -1))
            columns.append((ahead - behind) / (2.0 * step))
        return np.stack(columns, axis=2)

    def _by_pose(self, values: Floats, points_c: Floats) -> Floats:
        """``(N, 2, 6)`` derivatives by ``se3_exp((translation, rotation)) @ T``."""
        step = 1e-6 * float(np.median(np.linalg.norm(points_c, axis=1)))
        by_point = np.stack(
            [
                (self._model.project(values, points_c + d) - self._model.project(values, points_c - d))
                / (2.0 * step)
                for d in step * np.eye(3)
            ],
            axis=2,
        )
        x, y, z = points_c.T
        zero = np.zeros_like(x)
        turning = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
        return np.concatenate([by_point, by_point @ turning], axis=2)


def _inverse(reduced: Floats, total: Floats) -> Floats:
    """Inverse of what the poses leave of the normal equations ``total``; large where nothing is left."""
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(reduced / np.outer(size, size))
    inverse = (vectors / np.maximum(values, _NOTHING_LEFT)) @ vectors.T
    return np.asarray(inverse / np.outer(size, size))


def _solve(
    A: list[Floats], B: list[Floats], C: list[Floats], a: list[Floats], c: list[Floats], damping: float
) -> tuple[Floats, list[Floats]]:
    """The damped step of intrinsics ``(P,)`` and of each pose ``(6,)``."""
    total = np.sum(A, axis=0)
    reduced = total + damping * np.diag(np.diag(total))
    gradient = np.sum(a, axis=0)
    damped = [C_v + damping * np.diag(np.diag(C_v)) for C_v in C]
    for B_v, C_v, c_v in zip(B, damped, c, strict=True):
        gain = np.linalg.solve(C_v, B_v.T).T
        reduced = reduced - gain @ B_v.T
        gradient = gradient - gain @ c_v
    step = -np.linalg.lstsq(reduced, gradient, rcond=None)[0]
    poses = [-np.linalg.solve(C_v, c_v + B_v.T @ step) for B_v, C_v, c_v in zip(B, damped, c, strict=True)]
    return step, poses
