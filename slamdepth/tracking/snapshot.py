# SPDX-License-Identifier: Apache-2.0
"""The map as it is between two frames, for whoever watches a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from slamdepth.typing import Floats, Ints

if TYPE_CHECKING:
    from slamdepth.tracking.map_tracker import MapTracker


@dataclass(frozen=True)
class MapSnapshot:
    """Copies of what a map holds; later changes of the map do not show in them.

    Attributes:
        map_id: number of the map, from 0 in the order of their start.
        timestamps_s: ``(K,)`` of the keyframes.
        T_world_camera: ``(K, 4, 4)`` their poses.
        points_m: ``(P, 3)`` landmarks that two or more keyframes see, metres of the map.
        loops: ``(L, 2)`` rows of the keyframes of each loop.
    """

    map_id: int
    timestamps_s: Floats
    T_world_camera: Floats
    points_m: Floats
    loops: Ints


class Watched(Protocol):
    """A tracker whose map can be copied between two frames."""

    def ask_for_snapshot(self) -> None: ...

    def take_snapshot(self) -> MapSnapshot | None: ...


def snapshot_of(tracked: MapTracker) -> MapSnapshot:
    """Copy a map that has a keyframe, while no thread changes it."""
    map_ = tracked.map
    return MapSnapshot(
        tracked.id,
        np.array([keyframe.frame.timestamp_s for keyframe in map_.keyframes]),
        np.array(map_.T_world_camera),
        map_.landmarks.position_w[map_.seen_by(2)],
        np.array(tracked.integration.loops.pairs, np.int64).reshape(-1, 2),
    )
