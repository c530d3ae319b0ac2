# SPDX-License-Identifier: Apache-2.0
"""A saved map of the rendered walk of ``tracking_scene``."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from tracking_scene import CAMERA, CONFIG, COUNT, frames

from slamdepth import Map, Reconstruction, Session, Tracker
from slamdepth.depth.sensor import SensorDepth
from slamdepth.types import Frame


def tracked(
    given: Iterable[Frame], start_map: Map | None = None, *, with_images: bool = False
) -> tuple[Tracker, Reconstruction, Map]:
    """A finished tracker, its result and its saved map."""
    tracker = Tracker(CAMERA, SensorDepth(), CONFIG, start_map=start_map)
    for frame in given:
        tracker.step(frame)
    result = tracker.finish()
    scale = {"sentence": "metric", "source": "sensor"}
    saved = tracker.saved_map(0, result, Session("walk", "sensor"), scale, with_images=with_images)
    return tracker, result, saved


@lru_cache
def walk_until(last: int) -> Map:
    """The map of the first frames."""
    return tracked(frames(range(last)))[2]


def saved_walk(*, with_images: bool = False) -> Map:
    """The map of the whole walk."""
    return tracked(frames(range(COUNT)), with_images=True)[2] if with_images else walk_until(COUNT)
