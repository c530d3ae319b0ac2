# SPDX-License-Identifier: Apache-2.0
"""Edges of the pose graph: odometry from what keyframes share, and loops as they were measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth.backend.pose_graph import Edge
from slamdepth.mapping.map_view import MapView
from slamdepth.typing import Floats, Ints

Arrays = Mapping[str, NDArray[Any]]

STEP_SIGMAS = (0.01, 0.02, 0.02)
"""Deviation of the step from one keyframe to the next: radians, metres, natural logarithm of the scale."""

_STRONG = 60  # shared landmarks from which on a step is known as well as STEP_SIGMAS say
_MAX_WEAKNESS = 20.0
_COVISIBLE = 80  # shared landmarks that make an edge
_MAX_PARTNERS = 10  # earlier keyframes that one is tied to, not counting the one just before it


def weakness(shared: Ints) -> Floats:
    """Factor on the deviations of a step between keyframes that share so many landmarks, 1 to 20.

    Tracking by few landmarks, over a blurred turn or a gap, may err grossly; by hundreds it hardly errs.
    """
    return np.clip(_STRONG / np.maximum(shared, 1), 1.0, _MAX_WEAKNESS)


def odometry_edges(map_: MapView, together: Ints, looser: float = 1.0) -> list[Edge]:
    """Edges between neighbours in time and between keyframes that share most landmarks.

    A keyframe's edges all come from the same observations, so each counts for its share only.

    Args:
        together: ``(K, K)`` landmarks that each two keyframes share, see :meth:`MapView.covisibility`.
        looser: factor on all deviations; above 1, those of weak steps grow by :func:`weakness`, too.
    """
    keyframes = map_.keyframes
    edges = []
    for j, keyframe in enumerate(keyframes[1:], start=1):
        shared = together[j, :j]
        best = np.argsort(-shared, kind="stable")[:_MAX_PARTNERS]
        partners = {j - 1, *best[shared[best] >= _COVISIBLE].tolist()}
        factor = np.full(j, np.sqrt(len(partners)))
        if looser > 1.0:
            factor *= looser * weakness(shared)
        if j in map_.starts:  # no odometry leads there: the loops that joined two maps do
            factor[j - 1] *= _MAX_WEAKNESS
        for i in sorted(partners):
            rotation, translation, log_scale = (float(sigma * factor[i]) for sigma in STEP_SIGMAS)
            T_i_j = keyframes[i].T_camera_world @ keyframe.T_world_camera
            edges.append(Edge(i, j, T_i_j, 1.0, (rotation, translation, log_scale)))
    return edges


@dataclass(frozen=True)
class MeasuredLoop:
    """A loop edge, and the units of its keyframes when it was measured.

    A correction of the map multiplies the metres of keyframes; the measurement stays what it was.
    """

    edge: Edge
    unit_i: float
    unit_j: float

    @staticmethod
    def of(edge: Edge, units: Floats) -> MeasuredLoop:
        """A loop measured in a map whose keyframes have ``units (K,)``, see :class:`MapKeyframe`."""
        return MeasuredLoop(edge, float(units[edge.i]), float(units[edge.j]))

    def in_units(self, units: Floats) -> Edge:
        """The edge in the metres that keyframes have now."""
        edge = self.edge
        scale_i, scale_j = units[edge.i] / self.unit_i, units[edge.j] / self.unit_j
        T_i_j = edge.T_i_j.copy()
        T_i_j[:3, 3] *= scale_i
        return replace(edge, T_i_j=T_i_j, scale_i_j=edge.scale_i_j * scale_i / scale_j)

    def renumbered(self, first: int) -> MeasuredLoop:
        """The same loop where the numbers of its keyframes grow by ``first``."""
        return replace(self, edge=replace(self.edge, i=self.edge.i + first, j=self.edge.j + first))


def edge_arrays(edges: Sequence[Edge]) -> dict[str, NDArray[Any]]:
    """Edges of the pose graph."""
    return {
        "keyframes": np.array([(e.i, e.j) for e in edges], dtype=np.int64).reshape(-1, 2),
        "T_i_j": np.array([e.T_i_j for e in edges], dtype=np.float64).reshape(-1, 4, 4),
        "scale_i_j": np.array([e.scale_i_j for e in edges], dtype=np.float64),
        "sigmas": np.array([e.sigmas for e in edges], dtype=np.float64).reshape(-1, 3),
    }


def edges_of(arrays: Arrays, *, is_loop: bool) -> list[Edge]:
    """What :func:`edge_arrays` was given."""
    return [
        Edge(int(i), int(j), np.array(T), float(scale), (float(a), float(b), float(c)), is_loop=is_loop)
        for (i, j), T, scale, (a, b, c) in zip(
            arrays["keyframes"], arrays["T_i_j"], arrays["scale_i_j"], arrays["sigmas"], strict=True
        )
    ]


def loop_arrays(loops: Sequence[MeasuredLoop]) -> dict[str, NDArray[Any]]:
    """Loops as they were measured."""
    units = np.array([(loop.unit_i, loop.unit_j) for loop in loops], dtype=np.float64).reshape(-1, 2)
    return {**edge_arrays([loop.edge for loop in loops]), "units": units}


def loops_of(arrays: Arrays) -> list[MeasuredLoop]:
    """What :func:`loop_arrays` was given."""
    edges = edges_of(arrays, is_loop=True)
    return [
        MeasuredLoop(edge, float(units[0]), float(units[1]))
        for edge, units in zip(edges, arrays["units"], strict=True)
    ]
