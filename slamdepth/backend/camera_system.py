# SPDX-License-Identifier: Apache-2.0
"""The equations of the cameras that are left when the points are eliminated, and their solution.

With ``Hpp = C C^T`` and ``Z = Hcp C^-T`` they are ``Hcc - Z Z^T``, one symmetric product. Of a few hundred
cameras it is kept dense and factorised. Of more it is kept sparse and solved by conjugate gradients, so that
memory and time grow with what cameras share; the preconditioner solves clusters of consecutive cameras (Kushal
and Agarwal, "Visibility Based Preconditioning for Bundle Adjustment", CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slamdepth.backend.normal_equations import CAM
from slamdepth.backend.sightings import Sightings
from slamdepth.typing import Bools, Floats

Solve = Callable[[Floats], Floats]

_DENSE_PRODUCT = 4_000_000  # numbers in Z before it is kept sparse
_DENSE_CAMERAS = 400  # before what is left is kept sparse
_CLUSTER = 40  # consecutive cameras
_SOLVED = 1e-6  # of the right side
_MAX_ITERATIONS = 500
_SCALE = CAM - 1


class CameraSystem:
    """Which numbers of the cameras are unknown, and their equations without the points.

    A camera that may move has six unknowns and, with depth scales, a seventh. A fixed one that has depth has
    its scale.

    Args:
        points: number of points.
        scaled: ``(K,)`` slots whose depth scale is an unknown; see :class:`Sightings`.

    Attributes:
        size: number of unknowns.
    """

    def __init__(self, sightings: Sightings, points: int, scaled: Bools) -> None:
        self._sightings = sightings
        self._points = points
        free = sightings.free
        self._each = CAM if scaled.any() else CAM - 1  # of a camera that may move
        self._pinned = free + np.flatnonzero(scaled[free:])
        self._of_moving = self._each * free
        self.size = self._of_moving + len(self._pinned)

    def packed(self, of_slot: Floats) -> Floats:
        """The unknowns ``(size,)`` among values ``(K, 7)``."""
        moving = of_slot[: self._sightings.free, : self._each]
        return np.concatenate([moving.ravel(), of_slot[self._pinned, _SCALE]])

    def unpacked(self, x: Floats) -> Floats:
        """``(K, 7)`` of unknowns ``(size,)``; what is known is 0."""
        out = np.zeros((len(self._sightings.counts), CAM))
        free = self._sightings.free
        out[:free, : self._each] = x[: self._of_moving].reshape(free, self._each)
        out[self._pinned, _SCALE] = x[self._of_moving :]
        return out

    def solver(self, Hcc: Floats, Z: Floats, z_pinned: Floats) -> Solve:
        """Solves ``(Hcc - Z Z^T) x = b`` for ``b (size,)``.

        Args:
            Hcc: ``(K, 7, 7)``.
            Z: ``(7, 3, N)`` of the observations of cameras that may move.
            z_pinned: ``(3, M)`` its row of the depth scale, of the observations of fixed cameras.
        """
        if self.size == 0:
            return lambda b: b
        if self.size * self._points * 3 <= _DENSE_PRODUCT:
            S = self._dense_product(Z, z_pinned)
        else:
            product = self._sparse_product(Z, z_pinned)
            if self._sightings.free > _DENSE_CAMERAS:
                return self._iterative(Hcc, product)
            S = product.toarray()
        np.negative(S, out=S)
        moving = S[: self._of_moving, : self._of_moving]
        free, each = self._sightings.free, np.arange(self._sightings.free)
        blocks = moving.reshape(free, self._each, free, self._each)
        blocks[each, :, each] += Hcc[:free, : self._each, : self._each]
        pinned = np.arange(self._of_moving, self.size)
        S[pinned, pinned] += Hcc[self._pinned, _SCALE, _SCALE]
        return _factorised(S)

    def _dense_product(self, Z: Floats, z_pinned: Floats) -> Floats:
        sightings, each = self._sightings, self._each
        dense = np.zeros((self.size, 3, self._points))
        for slot in range(sightings.free):
            block = sightings.block(slot)
            dense[each * slot : each * (slot + 1)][:, :, sightings.pt[block]] = Z[:each, :, block]
        first = sightings.moving
        for row, slot in enumerate(self._pinned.tolist(), start=self._of_moving):
            block = sightings.block(slot)
            dense[row][:, sightings.pt[block]] = z_pinned[:, block.start - first : block.stop - first]
        flat = dense.reshape(self.size, 3 * self._points)
        return np.asarray(flat @ flat.T)

    def _sparse_product(self, Z: Floats, z_pinned: Floats) -> Any:
        from scipy.sparse import bsr_matrix, csr_matrix

        sightings, each, columns = self._sightings, self._each, 3 * self._points
        free, first = sightings.free, sightings.moving
        moving = bsr_matrix(
            (np.ascontiguousarray(Z[:each].transpose(2, 0, 1)), sightings.pt[:first], sightings.ends[: free + 1]),
            shape=(self._of_moving, columns),
        )
        product = moving @ moving.T
        if not len(self._pinned):
            return product
        from scipy.sparse import bmat

        fixed = csr_matrix(
            (
                z_pinned.T.ravel(),
                (3 * sightings.pt[first:, None] + np.arange(3)).ravel(),
                3 * (sightings.ends[free:] - first),
            ),
            shape=(len(sightings.counts) - free, columns),
        )[self._pinned - free]
        across = moving @ fixed.T
        return bmat([[product, across], [across.T, fixed @ fixed.T]], format="csr")

    def _iterative(self, Hcc: Floats, product: Any) -> Solve:
        """By conjugate gradients, from the sparse ``Z Z^T``."""
        from scipy.sparse import block_diag, bsr_matrix

        free, each = self._sightings.free, self._each
        places = np.arange(free + 1)
        diagonal = bsr_matrix((Hcc[:free, :each, :each], places[:-1], places))
        if len(self._pinned):
            diagonal = block_diag([diagonal, np.diag(Hcc[self._pinned, _SCALE, _SCALE])])
        S = (diagonal.tocsr() - product.tocsr()).tocsr()
        bounds = [*range(0, self._of_moving, each * _CLUSTER), self.size]
        clusters = [(a, b, _factorised(S[a:b, a:b].toarray())) for a, b in zip(bounds, bounds[1:])]

        def precondition(r: Floats) -> Floats:
            return np.concatenate([solve(r[a:b]) for a, b, solve in clusters])

        return lambda b: conjugate_gradients(lambda x: S @ x, b, precondition)


def conjugate_gradients(times: Solve, b: Floats, precondition: Solve) -> Floats:
    """Solution of a positive definite system, from the product of its matrix with a vector."""
    x = np.zeros_like(b)
    r = b.copy()
    z = precondition(r)
    p, rz = z, float(r @ z)
    goal = _SOLVED**2 * rz
    for _ in range(_MAX_ITERATIONS):
        if rz <= goal:
            break
        Ap = times(p)
        step = rz / float(p @ Ap)
        x += step * p
        r -= step * Ap
        z = precondition(r)
        before, rz = rz, float(r @ z)
        p = z + (rz / before) * p
    return x


def _factorised(S: Floats) -> Solve:
    """Solves ``S x = b`` for a symmetric ``S``, which may be overwritten."""
    from scipy.linalg.lapack import dpotrf, dpotrs

    factor, info = dpotrf(S.T, lower=1, overwrite_a=1, clean=0)
    if info == 0:
        return lambda b: np.asarray(dpotrs(factor, b, lower=1)[0], dtype=np.float64)
    upper = np.triu(S, 1)
    whole = upper + upper.T + np.diag(np.diag(S))
    return lambda b: np.asarray(np.linalg.lstsq(whole, b, rcond=None)[0], dtype=np.float64)
