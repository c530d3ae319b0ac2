# SPDX-License-Identifier: Apache-2.0
"""Multi-start for bundle adjustment: cameras that see little are re-registered from those that see much.

An adjustment ends in the minimum nearest to where it starts. A camera before a bare wall is placed by a
few points whose depth a network has guessed; it may be turned by ten degrees to fit them, and no number
of steps turns it back. So the cameras that share many points, which geometry alone determines, are kept, and
the others are added one by one as incremental structure from motion adds them (Schönberger and Frahm,
"Structure-from-Motion Revisited", CVPR 2016): resection from the points that registered cameras triangulate,
without predicted depth, a small adjustment, the next camera. The whole adjustment then decides which start
is better.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.geometry import backproject, invert, orthonormalised, rotation_angle_rad, transform
from slamdepth.typing import Bools, Ints

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
        order = np.argsort(problem.obs_camera, kind="stable")
        bounds = np.searchsorted(problem.obs_camera[order], np.arange(self._count + 1))
        self._seen_by = [order[bounds[k] : bounds[k + 1]] for k in range(self._count)]
        self._together = self._shared()
        self.T = problem.T_camera_world.copy()
        self.X = problem.points_w.copy()
        self._placed = self._best_held_piece()
        self._is_known = np.zeros(len(self.X), dtype=bool)
        self._grown: list[int] = []
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
            known = np.bincount(
                self._problem.obs_camera[self._is_known[self._problem.obs_point]], minlength=self._count
            )
            known[self._placed | failed] = 0
            k = int(np.argmax(known))
            if known[k] < _LEAST:
                break
            if not self._resect(k):
                failed[k] = True
                continue
            failed[:] = False  # what it sees may place others
            self._placed[k] = True
            self._grown.append(k)
            self._triangulate(self._problem.obs_point[self._seen_by[k]])
            self._adjust()

    def _resect(self, k: int) -> bool:
        p = self._problem
        seen = self._seen_by[k]
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
        """Points nearest to the rays of the placed cameras that see them."""
        p = self._problem
        wanted = np.zeros(len(self.X), dtype=bool)
        wanted[points] = True
        at = np.flatnonzero(wanted[p.obs_point] & self._placed[p.obs_camera])
        T_world_camera = invert(self.T)[p.obs_camera[at]]
        d = np.einsum("nij,nj->ni", T_world_camera[:, :3, :3], self._rays[at])
        Q = np.eye(3) - d[:, :, None] * d[:, None, :]
        A, b = np.zeros((len(self.X), 3, 3)), np.zeros((len(self.X), 3))
        np.add.at(A, p.obs_point[at], Q)
        np.add.at(b, p.obs_point[at], np.einsum("nij,nj->ni", Q, T_world_camera[:, :3, 3]))
        rows = np.flatnonzero(wanted)
        wide = np.linalg.eigvalsh(A[rows])[:, 0] >= _PARALLAX
        self._is_known[rows] = wide
        good = rows[wide]
        self.X[good] = np.linalg.solve(A[good], b[good][..., None])[..., 0]

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
        p = self._problem
        for k in self._grown:
            D = self.T[k] @ invert(p.T_camera_world[k])
            z = float(np.median(transform(self.T[k], self.X[p.obs_point[self._seen_by[k]]])[:, 2]))
            if rotation_angle_rad(D[:3, :3]) > _TURNED_RAD or np.linalg.norm(D[:3, 3]) > _MOVED * z:
                return True
        return False

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
