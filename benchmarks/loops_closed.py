# SPDX-License-Identifier: Apache-2.0
"""Which loops a tracker closed: the only place that looks inside the tracker for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.tracking import Tracker
from slamdepth.typing import Floats, Ints


@dataclass(frozen=True)
class ClosedLoop:
    """A loop in the pose graph.

    Attributes:
        earlier, later: its keyframes.
        T_earlier_later: ``(4, 4)`` what the loop measured, in metres of the finished map.
    """

    earlier: int
    later: int
    T_earlier_later: Floats


def closed_loops(tracker: Tracker, keyframe_ids: Sequence[int]) -> list[ClosedLoop]:
    """The loops between ``keyframe_ids`` that ``tracker``, which has finished, did not take back.

    Keyframes are named by their position in ``keyframe_ids``.
    """
    units, at = tracker._active.map.units, {k: n for n, k in enumerate(keyframe_ids)}
    edges = [loop.in_units(units) for loop in tracker._active.integration.loops._loops]
    return [ClosedLoop(at[edge.i], at[edge.j], edge.T_i_j) for edge in edges if {edge.i, edge.j} <= at.keys()]


def covisibility(tracker: Tracker, keyframe_ids: Sequence[int]) -> Ints:
    """How many landmarks each two of ``K`` keyframes share, ``(K, K)``."""
    return tracker._active.map.covisibility()[np.ix_(keyframe_ids, keyframe_ids)]


def taken_back(tracker: Tracker) -> int:
    """Loops that the pose graph of the largest map believed, and its observations did not."""
    return tracker._active.integration.loops.taken_back
