# SPDX-License-Identifier: Apache-2.0
"""Saved maps of several recordings made one, by places that their keyframes agree on."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slamdepth.config import Config
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import DatasetError
from slamdepth.frontend.preparation import Preparation
from slamdepth.loops.meeting import Meeting, find_meeting
from slamdepth.mapstore import Map, Session
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.atlas import Atlas
from slamdepth.tracking.finish import optimise_map
from slamdepth.tracking.map_parts import RunParts
from slamdepth.tracking.map_tracker import MapTracker
from slamdepth.tracking.saved_maps import load_map, save_merged, with_features_of
from slamdepth.tracking.wide_features import WideFeatures
from slamdepth.tracking.workers import DepthWorker, Workers

log = logging.getLogger(__name__)

_AGREEING = 3  # keyframes that must say the same, as while tracking


@dataclass(frozen=True)
class Merged:
    """Two maps that became one.

    Attributes:
        map: in the world and the metres of the first one.
        meetings: keyframes of the second one that saw a place of the first one, and agreed.
        scale: metres of the first map that one of the second was.
    """

    map: Map
    meetings: int
    scale: float


def merge_maps(first: Map, second: Map, config: Config | None = None) -> Merged | None:
    """Join a map to another one, where at least three keyframes agree on how.

    A place counts only if nothing else in either map looks like it, and the joined map must reproject as well
    as the two did.

    Args:
        first: gives the world frame, the scale and the camera.
        second: of another recording.

    Returns:
        None where they do not meet.

    Raises:
        DatasetError: the maps were made with different features or kinds of depth.
    """
    if first.is_measured != second.is_measured:
        raise DatasetError("one map was made with a sensor's depth, the other one with predicted depth")
    config = with_features_of(first, config)
    watch = Stopwatch()
    workers = Workers(DepthWorker(SensorDepth(), watch))
    try:
        with single_threaded():
            return _merged(first, second, config, workers, watch)
    finally:
        workers.close()


def _merged(first: Map, second: Map, config: Config, workers: Workers, watch: Stopwatch) -> Merged | None:
    camera = first.camera
    levels = Preparation(camera, config.features).levels
    wide = WideFeatures(camera, config.features, watch)
    run = RunParts(camera, config, levels, workers, watch, wide)
    atlas = Atlas(lambda number: MapTracker(number, run), config)
    there = atlas.active
    load_map(first, there, camera, config.features)
    here = atlas.add_loaded()
    load_map(second, here, camera, config.features)
    here.map.renumber_sessions(len(first.sessions))
    here.past.renumber_sessions(len(first.sessions))
    agreeing = _agreeing(here, there, config)
    if len(agreeing) < _AGREEING:
        log.info("%d keyframes agree on a place of the other map: too few", len(agreeing))
        return None
    scale = max(agreeing, key=lambda meeting: meeting.inliers).similarity.scale
    if not atlas.join(there, agreeing):
        return None
    joined = atlas.active
    optimise_map(joined, config)
    sessions: tuple[Session, ...] = (*first.sessions, *second.sessions)
    saved = save_merged(joined, first, sessions)
    return Merged(saved, len(agreeing), scale)


def _agreeing(here: MapTracker, there: MapTracker, config: Config) -> list[Meeting]:
    """The largest set of keyframes of one map that agree on where it lies in the other."""
    found = [
        meeting
        for keyframe in here.map.keyframes[1:]
        if (meeting := find_meeting(keyframe, here, there, config.loops.min_inliers)) is not None
    ]
    for meeting in found:
        log.info("keyframe %d sees a place of the other map", meeting.keyframe.id)
    sets = [[other for other in found if _agree(one, other)] for one in found]
    return max(sets, key=len, default=[])


def _agree(a: Meeting, b: Meeting) -> bool:
    return a is b or (a.agrees(b) and b.agrees(a))


def merge_all(maps: Sequence[Map], config: Config | None = None) -> tuple[Merged | None, list[int]]:
    """Join maps to the first one, in any order in which they meet it.

    Args:
        maps: two or more.

    Returns:
        The last join, None where there was none, and the places in ``maps`` of those that never met.
    """
    whole, left, last = maps[0], list(range(1, len(maps))), None
    goes_on = True
    while goes_on:
        goes_on = False
        for number in list(left):
            merged = merge_maps(whole, maps[number], config)
            if merged is None:
                continue
            before = 0 if last is None else last.meetings
            last = replace(merged, meetings=merged.meetings + before)
            whole = merged.map
            left.remove(number)
            goes_on = True
    return last, left
