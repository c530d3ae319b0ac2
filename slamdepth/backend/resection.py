# SPDX-License-Identifier: Apache-2.0
"""Multi-start for bundle adjustment: cameras that see little are re-registered from those that see much.

An adjustment ends in the minimum nearest to where it starts. A camera before a bare wall is placed by a
few points whose depth a network has guessed; it may be turned by ten degrees to fit them, and no number
of steps turns it back. So the cameras that share many points, which geometry alone determines, are kept, and
the others are added one by one as incremental structure from motion adds them (Schönberger and Frahm,
"Structure-from-Motion Revisited", CVPR 2016): resection from the points that registered cameras triangulate,
without predicted depth, a small adjustment, the next camera. As long as resection finds the cameras where
they are, they stay there and nothing is adjusted. The whole adjustment then decides which start is better.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.backend.point_blocks import SYMMETRIC, inverse
from slamdepth.geometry import backproject, invert, orthonormalised, rotation_angle_rad, transform
from slamdepth.typing import Bools, Floats, Ints

_LINKED = 0.4  # of the most points that two cameras share: so many and they belong together
_LEAST = 12  # triangulated points that a camera is placed by
_AGREEING = 0.6  # of them
_PARALLAX = 1.0 - np.cos(np.deg2rad(1.5))  # between the rays of a point that places others
_GATE_PX = 3.0  # in deviations of a keypoint
_FREE = 6  # cameras adjusted together after each one that was placed
_HELD = 8  # ... and placed cameras that hold them
_STEPS = (3, 3)
_TURNED_RAD = np.deg2rad(3.0)  # less is the same start
_MOVED = 0.06  # of the distance to what is seen
_IN_PLACE = 0.5  # of both: resection errs by as much


def multi_start(problem: BundleProblem) -> BundleProblem | None:
    """Another start for an adjustment.

    The first fixed camera stays where it is. Nothing is random: the same problem gives the same start.

    Args:
        problem: at least one camera is fixed.

    Returns:
        ``problem`` with other poses and points; None where no other start is worth a try.
    """
    growth = _Growth(problem)
    if not growth.is_possible:
        return None
    growth.grow()
    return growth.start() if growth.is_other() else None


class _Growth:
    """Cameras placed so far, and the points they triangulate."""

    def __init__(self, problem: BundleProblem) -> None:
        self._problem = problem
        self._count = len(problem.T_camera_world)
        self._seen_by = _ByIndex(problem.obs_camera, self._count)
        self._seeing = _ByIndex(problem.obs_point, len(problem.points_w))
        self._together = self._shared()
        self.T = problem.T_camera_world.copy()
        self.X = problem.points_w.copy()
        self._placed = self._best_held_piece()
        self._is_known = np.zeros(len(self.X), dtype=bool)
        self._known = np.zeros(self._count, dtype=np.int64)  # points that each camera sees and that are known
        self._grown: list[int] = []
        self._has_moved = False
        self._rays = backproject(problem.camera, problem.px, np.ones(len(problem.px)))
        self._rays /= np.linalg.norm(self._rays, axis=1, keepdims=True)
        self.is_possible = 3 <= np.count_nonzero(self._placed) < self._count

    def _shared(self) -> Ints:
        """How many points two cameras both see, ``(K, K)``."""
        from scipy.sparse import csr_matrix

        p = self._problem
        seen = csr_matrix(
            (np.ones(len(p.obs_camera), np.int64), (p.obs_camera, p.obs_point)),
            shape=(self._count, len(p.points_w)),
        )
        return np.asarray((seen @ seen.T).toarray())

    def _best_held_piece(self) -> Bools:
        """The largest set of cameras in which each shares many points with another."""
        from scipy.sparse.csgraph import connected_components

        between = self._together - np.diag(np.diag(self._together))
        label = connected_components(between >= max(_LINKED * between.max(), 1), directed=False)[1]
        return np.asarray(label == int(np.argmax(np.bincount(label))))

    def grow(self) -> None:
        """Place one camera after the other, that which sees most of what is known first."""
        self._triangulate(np.arange(len(self.X)))
        failed = np.zeros(self._count, dtype=bool)
        while True:
            known = np.where(self._placed | failed, 0, self._known)
            k = int(np.argmax(known))
            if known[k] < _LEAST:
                break
            if not self._resect(k):
                failed[k] = True
                continue
            failed[:] = False  # what it sees may place others
            self._placed[k] = True
            self._grown.append(k)
            self._has_moved |= self._is_elsewhere(k, _IN_PLACE)
            if not self._has_moved:
                self.T[k] = self._problem.T_camera_world[k]
            self._triangulate(self._problem.obs_point[self._seen_by.of(k)])
            if self._has_moved:
                self._adjust()

    def _resect(self, k: int) -> bool:
        p = self._problem
        seen = self._seen_by.of(k)
        seen = seen[self._is_known[p.obs_point[seen]]]
        points, px = self.X[p.obs_point[seen]], np.ascontiguousarray(p.px[seen])
        gate_px = _GATE_PX * float(np.median(p.sigma_px[seen]))
        found, rvec, tvec, agreeing = cv2.solvePnPRansac(
            points, px, p.camera.K, None, iterationsCount=200, reprojectionError=gate_px,
            confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not found or agreeing is None or len(agreeing) < max(_LEAST, _AGREEING * len(seen)):
            return False
        at = agreeing.ravel()
        rvec, tvec = cv2.solvePnPRefineLM(points[at], px[at], p.camera.K, None, rvec, tvec)
        self.T[k] = np.eye(4)
        self.T[k, :3, :3], self.T[k, :3, 3] = cv2.Rodrigues(rvec)[0], tvec.ravel()
        return True

    def _triangulate(self, points: Ints) -> None:
        """Each of ``points (N,)`` nearest to the rays of the placed cameras that see it."""
        p = self._problem
        at, row = self._seeing.of_each(points)
        is_placed = self._placed[p.obs_camera[at]]
        at, row = at[is_placed], row[is_placed]
        T_world_camera = invert(self.T)[p.obs_camera[at]]
        d = np.einsum("nij,nj->in", T_world_camera[:, :3, :3], self._rays[at])
        center = T_world_camera[:, :3, 3].T
        off = center - d * (d * center).sum(axis=0)

        def by_point(values: Floats) -> Floats:
            return np.asarray(np.bincount(row, values, minlength=len(points)), dtype=np.float64)

        A = np.stack([by_point((i == j) - d[i] * d[j]) for i, j in SYMMETRIC])
        b = np.stack([by_point(axis) for axis in off])
        is_wide = _exceeds(A, _PARALLAX)
        good = points[is_wide]
        self.X[good] = np.einsum("nij,jn->ni", inverse(A[:, is_wide]), b[:, is_wide])
        changed = points[self._is_known[points] != is_wide]
        self._is_known[points] = is_wide
        at, row = self._seeing.of_each(changed)
        sign = np.where(self._is_known[changed], 1, -1)[row]
        np.add.at(self._known, p.obs_camera[at], sign)

    def _adjust(self) -> None:
        """The cameras placed last, held by those that share most points with them; no predicted depth."""
        free = self._grown[-_FREE:]
        others = self._together[free].sum(axis=0)
        others[free] = 0
        others[~self._placed] = 0
        held = np.argsort(-others, kind="stable")[:_HELD]
        held = held[others[held] > 0]
        cameras = np.array([*free, *held.tolist()])
        is_fixed = np.arange(len(cameras)) >= len(free)
        is_fixed[0] |= not len(held)
        p = self._problem
        slot = np.full(self._count, -1)
        slot[cameras] = np.arange(len(cameras))
        at = np.flatnonzero((slot[p.obs_camera] >= 0) & self._is_known[p.obs_point])
        rows, obs_point = np.unique(p.obs_point[at], return_inverse=True)
        part = replace(
            p,
            T_camera_world=self.T[cameras],
            fixed=is_fixed,
            points_w=self.X[rows],
            obs_camera=slot[p.obs_camera[at]],
            obs_point=obs_point,
            px=p.px[at],
            sigma_px=p.sigma_px[at],
            log_depth=np.full(len(at), np.nan),
            sigma_log=np.ones(len(at)),
            sigma_scale=0.0,
            px_rate=None,
            doubt=1.0,
        )
        found = bundle_adjust(part, _STEPS)
        self.T[cameras] = found.T_camera_world
        self.X[rows] = found.points_w

    def is_other(self) -> bool:
        """Whether a camera was placed elsewhere than where the problem has it."""
        return self._has_moved and any(self._is_elsewhere(k, 1.0) for k in self._grown)

    def _is_elsewhere(self, k: int, share: float) -> bool:
        """Whether a camera is turned or moved by more than a ``share`` of what makes another start."""
        p = self._problem
        D = self.T[k] @ invert(p.T_camera_world[k])
        points = self.X[p.obs_point[self._seen_by.of(k)]]
        z = float(np.median(points @ self.T[k, 2, :3] + self.T[k, 2, 3]))
        is_turned = float(rotation_angle_rad(D[:3, :3])) > share * _TURNED_RAD
        return is_turned or float(np.linalg.norm(D[:3, 3])) > share * _MOVED * z

    def start(self) -> BundleProblem:
        """The problem from where the cameras were placed.

        A camera that was not moves with the nearest that was, a point that was not triangulated
        with the first camera that sees it.
        """
        p = self._problem
        at = np.flatnonzero(self._placed)
        nearest = at[np.argmin(np.abs(np.arange(self._count)[:, None] - at), axis=1)]
        left = np.flatnonzero(~self._placed)
        T, X = self.T.copy(), self.X.copy()
        T[left] = p.T_camera_world[left] @ invert(p.T_camera_world[nearest[left]]) @ self.T[nearest[left]]
        first = np.full(len(X), -1)
        first[p.obs_point[::-1]] = p.obs_camera[::-1]
        riders = np.flatnonzero(~self._is_known & (first >= 0))
        motion = invert(T)[first[riders]] @ p.T_camera_world[first[riders]]
        X[riders] = np.einsum("nij,nj->ni", motion[:, :3, :3], p.points_w[riders]) + motion[:, :3, 3]
        held = int(np.flatnonzero(p.fixed)[0])
        T_old_new = invert(p.T_camera_world[held]) @ T[held]
        T = orthonormalised(T @ invert(T_old_new))
        T[held] = p.T_camera_world[held]
        return replace(p, T_camera_world=T, points_w=transform(T_old_new, X))


class _ByIndex:
    """Which observations belong to each camera, or to each point."""

    def __init__(self, index: Ints, count: int) -> None:
        self._order = np.argsort(index, kind="stable")
        self._ends = np.concatenate([[0], np.cumsum(np.bincount(index, minlength=count))])

    def of(self, k: int) -> Ints:
        """Those of one, ascending."""
        return self._order[self._ends[k] : self._ends[k + 1]]

    def of_each(self, wanted: Ints) -> tuple[Ints, Ints]:
        """Those of each of ``wanted (N,)``, and the place in ``wanted`` that each belongs to."""
        counts = self._ends[wanted + 1] - self._ends[wanted]
        row = np.repeat(np.arange(len(wanted)), counts)
        first = self._ends[wanted] - (np.cumsum(counts) - counts)
        return self._order[np.arange(len(row)) + first[row]], row


def _exceeds(A: Floats, least: float) -> Bools:
    """Whether all eigenvalues of symmetric blocks ``(6, N)`` exceed a number (Sylvester's criterion)."""
    a00, a01, a02, a11, a12, a22 = A
    a00, a11, a22 = a00 - least, a11 - least, a22 - least
    minor = a00 * a11 - a01 * a01
    det = a22 * minor - a00 * a12 * a12 - a11 * a02 * a02 + 2.0 * a01 * a02 * a12
    return np.asarray((a00 > 0.0) & (minor > 0.0) & (det > 0.0))
