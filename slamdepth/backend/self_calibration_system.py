# SPDX-License-Identifier: Apache-2.0
"""The normal equations of self-calibration, with the points eliminated (Schur complement)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from slamdepth.backend.sights import Lens, Seen, Sights
from slamdepth.typing import Bools, Floats, Ints

RIDGE = 1e-2
"""Information on the logarithm of each distance: a factor of 2e4 either way."""


@dataclass(frozen=True)
class Step:
    """What to change: images that may move ``(K, 6)``, shared unknowns ``(S,)``, points ``(P, 3)``."""

    images: Floats
    shared: Floats
    points: Floats


class System:
    """The equations at a state.

    Args:
        sights: what the images see.
        seen: the same as the state predicts it.
        keep: ``(M,)`` observations that count.
        rotations: ``(K, 3, 3)`` of the images, camera from world.
        moving: ``(K,)`` images that may move.
        lens: the shared unknowns.
        free: ``(S,)`` which of them are to be found.
        pull, gradient: ``(S,)`` information of their prior, and the gradient of its cost.
        weight: ``(M,)`` square roots of the robust weights.
    """

    def __init__(
        self,
        sights: Sights,
        seen: Seen,
        keep: Bools,
        rotations: Floats,
        moving: Bools,
        lens: Lens,
        free: Ints,
        pull: Floats,
        gradient: Floats,
        weight: Floats,
    ) -> None:
        from scipy.sparse import hstack

        camera, point = sights.obs_camera[keep], sights.obs_point[keep]
        self._camera, self._point, self._pull = camera, point, pull
        whiten = weight[keep] / sights.sigma_px[keep]
        self._r = seen.r[keep] * weight[keep, None]
        by_lens = lens.by_unknowns(seen, -sights.px_rate)[keep][:, :, free] * whiten[:, None, None]
        A = lens.by_point(seen)[keep] * whiten[:, None, None]
        P = seen.P[keep]
        # P moves by v + w x P
        by_image = np.concatenate([A, np.cross(P[:, None, :], A)], axis=2)
        self.distance: Floats = np.ones(len(sights.points_w))
        self.distance[point] = np.linalg.norm(P, axis=1)
        by_point = (A @ rotations[camera]) * self.distance[point][:, None, None]

        slot = np.cumsum(moving) - 1
        at = np.flatnonzero(moving[camera])
        self._images = int(np.count_nonzero(moving))
        points = len(sights.points_w)
        of_image = _sparse(by_image[at], at, slot[camera[at]], len(P), self._images)
        every = np.arange(len(P))
        self._Jp = _sparse(by_point, every, point, len(P), points)
        self._J = hstack([of_image, by_lens.reshape(-1, len(free))], format="csr")
        self._Hpp = np.zeros((points, 3, 3))
        np.add.at(self._Hpp, point, np.einsum("nij,nik->njk", by_point, by_point))
        self._Hpp += RIDGE * np.eye(3)
        flat = self._r.ravel()
        self._b: Floats = np.asarray(self._J.T @ flat)
        self._b[6 * self._images :] += gradient
        self._bp: Floats = np.asarray(self._Jp.T @ flat)
        self._H: Floats = (self._J.T @ self._J).toarray()
        last = np.arange(6 * self._images, len(self._H))
        self._H[last, last] += pull
        self._cross = (self._J.T @ self._Jp).tocsr()

    def step(self, damping: float) -> Step:
        """The step to the minimum of the damped quadratic model."""
        from scipy.linalg import cho_factor, cho_solve

        S, Z, blocks = self._reduced(damping)
        y = blocks @ self._bp
        delta: Floats = -cho_solve(cho_factor(S), self._b - Z @ y)
        points = -(blocks.T @ (y + Z.T @ delta)).reshape(-1, 3) * self.distance[:, None]
        images = 6 * self._images
        return Step(delta[:images].reshape(-1, 6), delta[images:], points)

    def covariances(self) -> tuple[Floats, Floats]:
        """Of the shared unknowns: with errors in groups, and with independent ones; ``(S, S)`` each."""
        S, Z, blocks = self._reduced(0.0)
        images = 6 * self._images
        inverse: Floats = np.asarray(np.linalg.inv(S), dtype=np.float64)[images:]
        naive: Floats = inverse[:, images:]
        # influence of each residual on the shared unknowns, which all other unknowns follow
        influence = np.asarray(inverse @ (self._J - self._Jp @ (blocks.T @ Z.T)).T)
        each = np.einsum("snj,nj->ns", influence.reshape(len(naive), -1, 2), self._r)
        of_prior = naive @ np.diag(self._pull) @ naive
        by_point, by_image = _in_groups(each, self._point), _in_groups(each, self._camera)
        both = by_point + by_image - each.T @ each
        # the difference may come out too small by chance
        grouped: Floats = max((both, by_point, by_image), key=lambda one: float(one[0, 0]))
        return grouped + of_prior, naive

    def _reduced(self, damping: float) -> tuple[Floats, Any, Any]:
        """The equations of images and shared unknowns; what eliminates the points, and their factors."""
        from scipy.sparse import bsr_matrix

        points = len(self._Hpp)
        Hpp = self._Hpp.copy()
        diagonal = np.arange(3)
        Hpp[:, diagonal, diagonal] *= 1.0 + damping
        M: Floats = np.linalg.inv(np.linalg.cholesky(Hpp))
        blocks = bsr_matrix((M, np.arange(points), np.arange(points + 1)), shape=(3 * points, 3 * points))
        Z = (self._cross @ blocks.T).tocsr()
        S = self._H - (Z @ Z.T).toarray()
        diagonal = np.arange(len(S))
        # the scale of each map is free
        S[diagonal, diagonal] += (damping + 1e-9) * np.diag(self._H) + 1e-6
        return S, Z, blocks


def _sparse(blocks: Floats, rows: Ints, columns: Ints, observations: int, count: int) -> Any:
    """Blocks ``(N, 2, C)`` in two rows of each observation and ``C`` columns of each of ``count`` things."""
    from scipy.sparse import csr_matrix

    width = blocks.shape[2]
    row = np.broadcast_to((2 * rows[:, None] + np.arange(2))[:, :, None], blocks.shape)
    column = np.broadcast_to((width * columns[:, None] + np.arange(width))[:, None, :], blocks.shape)
    shape = (2 * observations, width * count)
    return csr_matrix((blocks.ravel(), (row.ravel(), column.ravel())), shape=shape)


def _in_groups(each: Floats, groups: Ints) -> Floats:
    """Sum of squares ``(S, S)`` of the sums of ``each (N, S)`` over groups."""
    _, index = np.unique(groups, return_inverse=True)
    sums = np.zeros((int(index.max()) + 1, each.shape[1]))
    np.add.at(sums, index, each)
    return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))
