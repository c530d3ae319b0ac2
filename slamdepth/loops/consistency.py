# SPDX-License-Identifier: Apache-2.0
"""Verified loops that the odometry calls impossible, kept until others say the same.

After a large drift a true loop contradicts the odometry as much as a false one does. What
tells them apart is that true ones agree with one another: seen from the next keyframes the
same place lies where the first said (the pairwise consistency of Mangelson et al.,
"Pairwise Consistent Measurement Set Maximization for Robust Multi-Robot Map Merging", 2018;
ORB-SLAM asks for three consistent detections in a row).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from slamdepth.backend.pose_graph import Edge
from slamdepth.geometry import invert, rotation_angle_rad
from slamdepth.loops.edges import STEP_SIGMAS
from slamdepth.typing import Floats

_AGREEING = 3  # keyframes that must see the same place
_REMEMBERED = 12  # keyframes a refused loop is kept for: farther apart, drift hides agreement
_AGREEMENT = 2.0  # deviations of every step between two loops that agree
_INSISTING_AMONG = 6  # latest keyframes
_STEP_RAD, _STEP_M = 0.6, 0.5  # that a camera may move from one keyframe to the next
_DRIFT = 3.0  # deviations of every step that a loop may ask odometry to have erred by


class RefusedLoops:
    """The loops refused lately, the best one of each keyframe."""

    def __init__(self) -> None:
        self._edges: dict[int, Edge] = {}

    def add(self, edge: Edge) -> None:
        """Remember a refused loop unless its keyframe has one."""
        self._edges = {j: e for j, e in self._edges.items() if j > edge.j - _REMEMBERED}
        self._edges.setdefault(edge.j, edge)

    def clear(self) -> None:
        """Drop all, after the map was corrected."""
        self._edges.clear()

    def insisted(self, T_world_camera: Floats, *, with_scale: bool) -> list[Edge]:
        """The latest refused loops where they say that odometry is wrong now; else none.

        Three of the last six keyframes have one, the camera could have moved between them as they say,
        and odometry has it otherwise. Loops that agree with odometry about the motion between them may come
        from a place that looks like another, see :meth:`confirmed`.

        Args:
            T_world_camera: ``(K, 4, 4)`` poses of all keyframes as they are.
            with_scale: whether scale may have drifted too.
        """
        newest = max(self._edges, default=0)
        latest = [self._edges[j] for j in sorted(self._edges) if j > newest - _INSISTING_AMONG]
        pairs = list(pairwise(latest))
        if len(latest) < _AGREEING or not all(_could_move(a, b, T_world_camera) for a, b in pairs):
            return []
        return [] if all(_agree(a, b, T_world_camera, with_scale) for a, b in pairs) else latest

    def confirmed(self, edge: Edge, T_world_camera: Floats, *, with_scale: bool) -> list[Edge]:
        """The loops that agree with ``edge``, itself last; empty where too few do.

        Args:
            T_world_camera: ``(K, 4, 4)`` poses of all keyframes as they are.
            with_scale: whether scale may have drifted too.
        """
        if not _is_within(_error(edge, T_world_camera), _DRIFT * (edge.j - edge.i), with_scale):
            return []
        agreeing = [
            other
            for other in self._edges.values()
            if other.j != edge.j and _agree(other, edge, T_world_camera, with_scale)
        ]
        return [*agreeing, edge] if len(agreeing) + 1 >= _AGREEING else []


def _similarity(edge: Edge) -> tuple[Floats, float]:
    """``T_i_j`` and the metres of i that one of j is."""
    return edge.T_i_j, edge.scale_i_j


def _agree(other: Edge, edge: Edge, T_world_camera: Floats, with_scale: bool) -> bool:
    """Whether two loops say the same, as far as odometry between their ends can be trusted."""
    steps = abs(other.i - edge.i) + abs(other.j - edge.j)
    through = _through(other, edge, T_world_camera)
    return _is_within(_difference(_similarity(edge), through), _AGREEMENT * (1 + steps), with_scale)


def _could_move(a: Edge, b: Edge, T_world_camera: Floats) -> bool:
    """Whether a camera could move from where ``a`` places its keyframe to where ``b`` places a later one."""
    there_a, there_b = (T_world_camera[edge.i] @ edge.T_i_j for edge in (a, b))
    D, steps = invert(there_a) @ there_b, b.j - a.j
    turned, moved_m = float(rotation_angle_rad(D[:3, :3])), float(np.linalg.norm(D[:3, 3]))
    return turned <= steps * _STEP_RAD and moved_m <= steps * _STEP_M


def _through(other: Edge, edge: Edge, T_world_camera: Floats) -> tuple[Floats, float]:
    """What ``other`` says about the keyframes of ``edge``: from i to its i, over it, from its j to j."""
    before = invert(T_world_camera[edge.i]) @ T_world_camera[other.i]
    after = invert(T_world_camera[other.j]) @ T_world_camera[edge.j]
    after[:3, 3] *= other.scale_i_j
    return before @ other.T_i_j @ after, other.scale_i_j


def _error(edge: Edge, T_world_camera: Floats) -> tuple[float, float, float]:
    present = invert(T_world_camera[edge.i]) @ T_world_camera[edge.j]
    return _difference(_similarity(edge), (present, 1.0))


def _difference(a: tuple[Floats, float], b: tuple[Floats, float]) -> tuple[float, float, float]:
    """Between two similarities: radians, metres, absolute logarithm of the ratio of scales."""
    turned = float(rotation_angle_rad(a[0][:3, :3].T @ b[0][:3, :3]))
    return turned, float(np.linalg.norm(a[0][:3, 3] - b[0][:3, 3])), abs(float(np.log(a[1] / b[1])))


def _is_within(error: tuple[float, float, float], steps: float, with_scale: bool) -> bool:
    bounds = [steps * sigma for sigma in STEP_SIGMAS]
    return all(e <= bound for e, bound in zip(error[: 3 if with_scale else 2], bounds, strict=False))
