# SPDX-License-Identifier: Apache-2.0
"""Verified loops that contradict odometry, kept until others confirm them.

After a large drift a true loop contradicts the odometry as much as a false one does. True ones agree with
one another: from the next keyframes the same place is seen where the first loop says (the pairwise
consistency of Mangelson et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-Robot
Map Merging", 2018; ORB-SLAM asks for three consistent detections in a row). But so do false ones: to walk
along one of two identical desks is to walk along the other. So agreement counts only as far as odometry can
have drifted, and loops that contradict odometry and one another are no evidence at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.backend.pose_graph import Edge
from slamdepth.geometry import invert, rotation_angle_rad
from slamdepth.loops.edges import STEP_SIGMAS
from slamdepth.typing import Floats, Ints

_AGREEING = 3  # keyframes that must see the same place
_REMEMBERED = 12  # keyframes a refused loop is kept for: farther apart, drift hides agreement
_AGREEMENT = 2.0  # deviations of every step between two loops that agree
_DRIFT = 3.0  # deviations that odometry may have drifted by
_STEADY = (0.003, 0.0, 0.003)  # radians, metres and log scale that every step may err by in one direction
_STEADY_PATH = 0.03  # of the path
_MEASURED = 0.5  # of all that, where a sensor measures the depth
_ASIDE = np.pi / 3.0  # between two views of a surface: farther aside its features look different


@dataclass(frozen=True)
class Drift:
    """How far odometry may have drifted between keyframes.

    Attributes:
        T_world_camera: ``(K, 4, 4)`` poses of all keyframes.
        weakness: ``(K - 1,)`` of each step, see :func:`~slamdepth.loops.edges.weakness`.
        is_measured: a sensor's depth made the map: the scale cannot drift, and the pose drifts less.
    """

    T_world_camera: Floats
    weakness: Floats
    is_measured: bool

    @property
    def dimensions(self) -> int:
        """Of rotation, translation and scale those that may drift."""
        return 2 if self.is_measured else 3

    def bounds(self, j: int) -> Floats:
        """What may have been lost from each earlier keyframe to keyframe ``j``, ``(j, 3)``.

        A random walk over the steps, and a share of the way in one direction; radians, metres and logarithm
        of the scale.
        """
        steps_m = np.linalg.norm(np.diff(self.T_world_camera[: j + 1, :3, 3], axis=0), axis=1)
        walk = _DRIFT * np.sqrt(_sums_to_end(self.weakness[:j] ** 2))
        lost = walk[:, None] * STEP_SIGMAS + np.arange(j, 0, -1)[:, None] * _STEADY
        lost[:, 1] += _STEADY_PATH * _sums_to_end(steps_m)
        return np.asarray(lost * (_MEASURED if self.is_measured else 1.0))

    def nearby(self, j: int, reach_m: float) -> Ints:
        """Earlier keyframes that may see what keyframe ``j`` sees, as far as odometry can have drifted.

        Args:
            reach_m: how far two cameras that see the same surface may be apart.
        """
        T, lost = self.T_world_camera, self.bounds(j)
        apart_m = np.linalg.norm(T[:j, :3, 3] - T[j, :3, 3], axis=1)
        turned = rotation_angle_rad(np.swapaxes(T[:j, :3, :3], 1, 2) @ T[j, :3, :3])
        return np.flatnonzero((apart_m <= reach_m + lost[:, 1]) & (turned <= _ASIDE + lost[:, 0]))

    def explains(self, edge: Edge, share: float = 1.0) -> bool:
        """Whether the odometry between its keyframes may have drifted as much as a loop says.

        Args:
            share: of :meth:`bounds`.
        """
        i, j = sorted((edge.i, edge.j))
        error = _error(edge, self.T_world_camera)[: self.dimensions]
        return all(e <= share * bound for e, bound in zip(error, self.bounds(j)[i], strict=False))


class RefusedLoops:
    """The loops refused lately that a drift of odometry would explain."""

    def __init__(self) -> None:
        self._edges: list[Edge] = []

    def add(self, edge: Edge, drift: Drift) -> None:
        """Remember a refused loop, unless no drift explains it: then nothing can confirm it."""
        self._edges = [e for e in self._edges if e.j > edge.j - _REMEMBERED]
        if drift.explains(edge):
            self._edges.append(edge)

    @property
    def edges(self) -> list[Edge]:
        """Those that are remembered."""
        return list(self._edges)

    def restore(self, edges: list[Edge]) -> None:
        """Remember these, and no other."""
        self._edges = list(edges)

    def clear(self) -> None:
        """Drop all, after the map was corrected."""
        self._edges.clear()

    def confirmed(self, edge: Edge, drift: Drift) -> list[Edge]:
        """The loops that agree with ``edge``, itself last.

        Returns:
            Empty where too few agree, or no drift explains the loop, or one explains a rival as well: where
            odometry allows two places that look alike, nothing tells which one was seen.
        """
        if not drift.explains(edge):
            return []
        agreeing: dict[int, Edge] = {}  # one of each keyframe
        for other in self._edges:
            if not _agree(other, edge, drift):
                if drift.explains(other):
                    return []
            elif other.j != edge.j:
                agreeing.setdefault(other.j, other)
        return [*agreeing.values(), edge] if len(agreeing) + 1 >= _AGREEING else []


def _sums_to_end(values: Floats) -> Floats:
    """Sum of each value and all after it."""
    return np.asarray(np.cumsum(values[::-1])[::-1])


def _similarity(edge: Edge) -> tuple[Floats, float]:
    """``T_i_j`` and the metres of i that one of j is."""
    return edge.T_i_j, edge.scale_i_j


def _agree(other: Edge, edge: Edge, drift: Drift) -> bool:
    """Whether two loops say the same, as far as odometry between their ends can be trusted."""
    steps = abs(other.i - edge.i) + abs(other.j - edge.j)
    difference = _difference(_similarity(edge), _through(other, edge, drift.T_world_camera))
    bounds = [_AGREEMENT * (1 + steps) * sigma for sigma in STEP_SIGMAS[: drift.dimensions]]
    return all(d <= bound for d, bound in zip(difference, bounds, strict=False))


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
