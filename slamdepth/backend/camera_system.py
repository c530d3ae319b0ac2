# SPDX-License-Identifier: Apache-2.0
"""The equations of the cameras that are left when the points are eliminated, and their solution.

They are ``Hcc - Z Z^T``. The product is taken by groups of consecutive cameras: two groups share few enough
of their points to leave the rest out, and enough for a product of matrices. Of a few hundred cameras the
result is kept dense and factorised. Of more it is kept sparse and solved by conjugate gradients, so that
memory and time grow with what cameras share. That is solved roughly, as the next step linearises anew
(Agarwal et al., "Bundle Adjustment in the Large", ECCV 2010); the preconditioner solves clusters of
consecutive cameras (Kushal and Agarwal, "Visibility Based Preconditioning for Bundle Adjustment", CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from slamdepth.backend.normal_equations import CAM
from slamdepth.backend.sightings import Sightings
from slamdepth.typing import Bools, Floats, Ints

Solve = Callable[[Floats], Floats]

_GROUP = 24  # unknowns
_DENSE_CAMERAS = 400
_CLUSTER = 40  # consecutive cameras
_SOLVED = 1e-2  # of the right side, in the norm of the preconditioner
_MAX_ITERATIONS = 500
_SCALE = CAM - 1


@dataclass(frozen=True)
class _Group:
    """Unknowns of consecutive cameras.

    Attributes:
        unknowns: where they lie among all.
        points: ``(Q,)`` that the cameras see.
        parts: of each camera its slot, the place of its unknowns in the group, its observations, and the rows
            of their points in ``points``.
    """

    unknowns: slice
    points: Ints
    parts: list[tuple[int, slice, slice, Ints]]


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
        self._groups = self._grouped()
        self._shared = self._shared_points()

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

    def _grouped(self) -> list[_Group]:
        sightings, each = self._sightings, self._each
        slots = [*range(sightings.free), *self._pinned.tolist()]
        widths = [each] * sightings.free + [1] * len(self._pinned)
        groups: list[_Group] = []
        first = at = 0
        while first < len(slots):
            last = first + 1
            width = widths[first]
            while last < len(slots) and width + widths[last] <= _GROUP:
                width += widths[last]
                last += 1
            blocks = [sightings.block(slot) for slot in slots[first:last]]
            points, rows = np.unique(
                np.concatenate([sightings.pt[block] for block in blocks]), return_inverse=True
            )
            ends = np.cumsum([block.stop - block.start for block in blocks])[:-1]
            places = np.concatenate([[0], np.cumsum(widths[first:last])]).tolist()
            parts = [
                (slot, slice(a, b), block, own)
                for slot, (a, b), block, own in zip(
                    slots[first:last], pairwise(places), blocks, np.split(rows, ends), strict=True
                )
            ]
            groups.append(_Group(slice(at, at + width), points, parts))
            first, at = last, at + width
        return groups

    def _shared_points(self) -> list[tuple[int, int, Ints, Ints]]:
        """Of each two groups that share points, their numbers and the rows of those points."""
        from scipy.sparse import csr_matrix

        groups = self._groups
        if len(groups) < 2:
            return []
        ends = np.concatenate([[0], np.cumsum([len(group.points) for group in groups])])
        points = np.concatenate([group.points for group in groups])
        sees = csr_matrix((np.ones(len(points), np.int32), points, ends), shape=(len(groups), self._points))
        together = (sees @ sees.T).tocsr()
        together.sort_indices()
        row = np.full(self._points, -1)
        shared = []
        for a, group in enumerate(groups):
            row[group.points] = np.arange(len(group.points))
            for b in together.indices[together.indptr[a] : together.indptr[a + 1]].tolist():
                if b > a:
                    of_a = row[groups[b].points]
                    of_b = np.flatnonzero(of_a >= 0)
                    shared.append((a, b, of_a[of_b], of_b))
            row[group.points] = -1
        return shared

    def solver(self, Hcc: Floats, Z: Callable[[slice], Floats], z_fixed: Floats) -> Solve:
        """Solves ``(Hcc - Z Z^T) x = b`` for ``b (size,)``.

        Args:
            Hcc: ``(K, 7, 7)``.
            Z: gives ``(N, 3, 7)`` of a part of the observations of cameras that may move: the whole is large.
            z_fixed: ``(3, M)`` its row of the depth scale, of the observations of fixed cameras.
        """
        if self.size == 0:
            return lambda b: b
        blocks = self._blocks(Hcc, Z, z_fixed)
        if self._sightings.free > _DENSE_CAMERAS:
            return self._iterative(blocks)
        S = np.zeros((self.size, self.size))
        for (a, b), block in blocks.items():  # one triangle is enough
            S[self._groups[a].unknowns, self._groups[b].unknowns] = block
        return _factorised(S)

    def _blocks(
        self, Hcc: Floats, Z: Callable[[slice], Floats], z_fixed: Floats
    ) -> dict[tuple[int, int], Floats]:
        """``Hcc - Z Z^T`` by groups, of each two once."""
        free, each, moving = self._sightings.free, self._each, self._sightings.moving
        wide = []
        found: dict[tuple[int, int], Floats] = {}
        for a, group in enumerate(self._groups):
            width = group.unknowns.stop - group.unknowns.start
            own = np.zeros((len(group.points), 3, width))
            block = np.zeros((width, width))
            first = group.parts[0][2].start
            by_row = Z(slice(min(first, moving), min(group.parts[-1][2].stop, moving)))
            for slot, place, seen, rows in group.parts:
                if slot < free:
                    own[rows, :, place] = by_row[seen.start - first : seen.stop - first, :, :each]
                    block[place, place] = Hcc[slot, :each, :each]
                else:
                    own[rows, :, place] = z_fixed[:, seen.start - moving : seen.stop - moving].T[..., None]
                    block[place, place] = Hcc[slot, _SCALE, _SCALE]
            flat = own.reshape(-1, width)
            block -= flat.T @ flat
            found[a, a] = block
            wide.append(own)
        for a, b, of_a, of_b in self._shared:
            mine, theirs = wide[a].take(of_a, axis=0), wide[b].take(of_b, axis=0)
            found[a, b] = -(mine.reshape(-1, mine.shape[2]).T @ theirs.reshape(-1, theirs.shape[2]))
        return found

    def _iterative(self, blocks: dict[tuple[int, int], Floats]) -> Solve:
        """By conjugate gradients."""
        S = self._sparse(blocks)
        step = max(_CLUSTER // (_GROUP // self._each), 1)
        starts = [group.unknowns.start for group in self._groups[::step]]
        clusters = [(a, b, _factorised(S[a:b, a:b].toarray())) for a, b in pairwise([*starts, self.size])]

        def precondition(r: Floats) -> Floats:
            return np.concatenate([solve(r[a:b]) for a, b, solve in clusters])

        return lambda b: conjugate_gradients(S.__matmul__, b, precondition)

    def _sparse(self, blocks: dict[tuple[int, int], Floats]) -> Any:
        """All blocks as one sparse matrix, both triangles."""
        from scipy.sparse import csr_matrix

        rows: list[list[tuple[int, Floats]]] = [[] for _ in self._groups]
        for (a, b), block in sorted(blocks.items()):
            rows[a].append((b, block))
            if a != b:
                rows[b].append((a, block.T))
        data, indices, counts = [], [], []
        for row in rows:
            row.sort(key=lambda entry: entry[0])
            whole = np.hstack([block for _, block in row])
            places = np.concatenate(
                [np.arange(self._groups[b].unknowns.start, self._groups[b].unknowns.stop) for b, _ in row]
            )
            data.append(whole.ravel())
            indices.append(np.tile(places.astype(np.int32), len(whole)))
            counts.append(np.full(len(whole), len(places)))
        ends = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        return csr_matrix((np.concatenate(data), np.concatenate(indices), ends), shape=(self.size, self.size))


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
    """Solves ``S x = b`` for a symmetric ``S``, of which the upper triangle is read."""
    from scipy.linalg.lapack import dpotrf, dpotrs

    factor, info = dpotrf(S.T, lower=1, clean=0)  # columns of S.T are rows of S: no copy is turned
    if info == 0:
        return lambda b: np.asarray(dpotrs(factor, b, lower=1)[0], dtype=np.float64)
    whole = np.triu(S) + np.triu(S, 1).T
    return lambda b: np.asarray(np.linalg.lstsq(whole, b, rcond=None)[0], dtype=np.float64)
