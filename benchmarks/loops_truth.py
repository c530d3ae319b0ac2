# SPDX-License-Identifier: Apache-2.0
"""Which loops are true, and which were there to be found, by the true poses of the keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.loops_closed import ClosedLoop
from benchmarks.places_truth import DIFFERENT, SAME, overlaps
from slamdepth.geometry import invert, rotation_angle_rad
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Bools, Floats, Floats32, Ints

FALSE_M, FALSE_DEG = 0.3, 10.0
"""A loop is false where the motion it says differs from the true one by more than this."""

LINKED = 15
"""Shared landmarks that tie two keyframes."""

ASIDE_DEG = 60.0
"""Views turned by more than this are no revisit: no tracker expects a landmark there, and ORB features, which
bear about 30 degrees, do not match. A hall seen from its other end shares surfaces, but no view."""

_WITHIN_S = 0.02
_MERGED_GAP = 2  # keyframes: shorter gaps do not end a revisit


@dataclass(frozen=True)
class TrueKeyframes:
    """True poses of ``K`` keyframes, and what they see.

    Attributes:
        piece: ``(K,)`` piece of the ground truth that has a keyframe's pose, -1 for none. Pieces have no
            common frame.
        T_world_camera: ``(K, 4, 4)`` in the frame and units of the piece.
        scale: true units that one metre of the map is.
        limit: length by which a true loop may be off, in true units.
        overlap: ``(K, K)`` share of the view that two keyframes have in common; NaN between pieces.
    """

    piece: Ints
    T_world_camera: Floats
    scale: float
    limit: float
    overlap: Floats

    def is_false(self, loop: ClosedLoop) -> bool | None:
        """Whether a loop is false; None where a true pose is missing."""
        i, j = loop.earlier, loop.later
        if self.piece[i] < 0 or self.piece[j] < 0:
            return None
        if self.piece[i] != self.piece[j]:
            return None
        if self.overlap[i, j] < DIFFERENT:
            return True
        D = invert(self.T_world_camera[i]) @ self.T_world_camera[j]
        far = float(np.linalg.norm(self.scale * loop.T_earlier_later[:3, 3] - D[:3, 3]))
        turned = float(rotation_angle_rad(loop.T_earlier_later[:3, :3].T @ D[:3, :3]))
        return bool(far > self.limit or turned > np.radians(FALSE_DEG))

    def same_earlier(self, min_gap: int, least: float) -> Bools:
        """``(K, K)`` True at ``[i, j]`` where j sees the place of i again, after a view of another place.

        Only from less than :data:`ASIDE_DEG` aside.

        Args:
            min_gap: keyframes from i to j, at least.
            least: overlap of i and j, at least.
        """
        count = len(self.piece)
        found = np.zeros((count, count), dtype=bool)
        for j in range(count):
            elsewhere = np.flatnonzero(self.overlap[:j, j] < DIFFERENT)  # False for NaN
            if len(elsewhere):
                found[: elsewhere[-1], j] = self.overlap[: elsewhere[-1], j] >= least
            found[max(0, j - min_gap + 1) :, j] = False
            turned = rotation_angle_rad(
                np.swapaxes(self.T_world_camera[:j, :3, :3], 1, 2) @ self.T_world_camera[j, :3, :3]
            )
            found[:j, j] &= turned <= np.radians(ASIDE_DEG)
        return found


def true_keyframes(
    times_s: Floats,
    T_map_camera: Floats,
    truths: Sequence[Trajectory],
    camera: Camera,
    depths: Sequence[Floats32],
    *,
    is_metric: bool,
    depth_is_true: bool,
) -> TrueKeyframes:
    """The true poses at the times of keyframes.

    Args:
        times_s: ``(K,)``.
        T_map_camera: ``(K, 4, 4)`` estimated poses.
        truths: pieces of true poses.
        depths: K images ``(H, W)``, 0 unknown.
        is_metric: whether the truth is in metres; else the limit is in metres of the map.
        depth_is_true: whether the depth is a sensor's, in metres; else it is in metres of the map.
    """
    piece = np.full(len(times_s), -1)
    T_true = np.tile(np.eye(4), (len(times_s), 1, 1))
    for p, truth in enumerate(truths):
        nearest = np.abs(truth.timestamps_s[None] - times_s[:, None]).argmin(axis=1)
        near = np.abs(truth.timestamps_s[nearest] - times_s) <= _WITHIN_S
        piece[near], T_true[near] = p, truth.T_world_camera[nearest[near]]
    scale = _scale(piece, T_true, T_map_camera)
    overlap = np.full((len(times_s), len(times_s)), np.nan)
    for p in range(len(truths)):
        at = np.flatnonzero(piece == p)
        scaled = [depths[int(k)] if depth_is_true else np.float32(scale) * depths[int(k)] for k in at]
        tolerance = 0.1 if depth_is_true else 0.3
        if len(at):
            overlap[np.ix_(at, at)] = overlaps(camera, scaled, T_true[at], tolerance=tolerance)
    limit = FALSE_M if is_metric else FALSE_M * scale
    return TrueKeyframes(piece, T_true, scale, limit, overlap)


def _scale(piece: Ints, T_true: Floats, T_map: Floats) -> float:
    """The median ratio of true and estimated steps, which few false loops leave alone."""
    ratios = []
    for a, b in pairwise(np.flatnonzero(piece >= 0)):
        true, found = (float(np.linalg.norm(T[b, :3, 3] - T[a, :3, 3])) for T in (T_true, T_map))
        if piece[a] == piece[b] and b == a + 1 and found > 1e-6:
            ratios.append(true / found)
    return float(np.median(ratios)) if ratios else 1.0


def runs(keyframes: Ints) -> list[Ints]:
    """Keyframe ids, ascending, in groups without large gaps."""
    if not len(keyframes):
        return []
    return np.split(keyframes, np.flatnonzero(np.diff(keyframes) > _MERGED_GAP) + 1)


def judge_loops(
    loops: Sequence[ClosedLoop], truth: TrueKeyframes, shared: Ints, min_gap: int
) -> dict[str, Any]:
    """Count true and false loops, and the revisits that were found.

    A revisit is a run of keyframes that see an earlier place after another one, and at least one of them sees
    much of it. It is found where a true loop ends in it, or where half of its keyframes share landmarks with
    that place: then tracking alone found it.

    Args:
        shared: ``(K, K)`` landmarks that two keyframes share in the finished map.
        min_gap: keyframes between the ends of a loop, at least.
    """
    verdicts = [truth.is_false(loop) for loop in loops]
    judged = list(zip(loops, verdicts, strict=True))
    ends = {loop.later for loop, is_false in judged if is_false is False}
    partly = truth.same_earlier(min_gap, DIFFERENT)
    mostly: Bools = np.any(truth.same_earlier(min_gap, SAME), axis=0)
    linked: Bools = np.any(partly & (shared >= LINKED), axis=0)
    visits = [visit for visit in runs(np.flatnonzero(partly.any(axis=0))) if mostly[visit].any()]
    by_loop = [any(int(k) in ends for k in visit) for visit in visits]
    by_any = [has_loop or bool(linked[v].mean() >= 0.5) for has_loop, v in zip(by_loop, visits, strict=True)]
    return {
        "closed": len(loops),
        "true": verdicts.count(False),
        "false": verdicts.count(True),
        "unknown": verdicts.count(None),
        "revisits": len(visits),
        "by_loop": sum(by_loop),
        "found": sum(by_any),
        "seen_again": int(np.count_nonzero(mostly)),
        "linked": int(np.count_nonzero(linked & mostly)),
        "false_loops": [[loop.earlier, loop.later] for loop, is_false in judged if is_false],
    }
