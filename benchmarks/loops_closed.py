# SPDX-License-Identifier: Apache-2.0
"""Which loops a tracker closed: the only place that looks inside the tracker for them."""

from __future__ import annotations

from dataclasses import dataclass

from slamdepth.tracking import Tracker
from slamdepth.typing import Floats, Ints


@dataclass(frozen=True)
class ClosedLoop:
    """A loop in the pose graph.

    Attributes:
        earlier, later: ids of its keyframes.
        T_earlier_later: ``(4, 4)`` what the loop measured, in metres of the finished map.
    """

    earlier: int
    later: int
    T_earlier_later: Floats


def closed_loops(tracker: Tracker) -> list[ClosedLoop]:
    """The loops that ``tracker``, which has finished, accepted and did not take back."""
    units = tracker._active.map.units
    edges = [loop.in_units(units) for loop in tracker._active.integration.loops._loops]
    return [ClosedLoop(edge.i, edge.j, edge.T_i_j) for edge in edges]


def covisibility(tracker: Tracker) -> Ints:
    """How many landmarks each two keyframes share, ``(K, K)``."""
    return tracker._active.map.covisibility()
