# SPDX-License-Identifier: Apache-2.0
"""The maps of a run: a new one where the camera stays lost, and one of two where they meet.

After the Atlas of ORB-SLAM3 (Campos et al., "ORB-SLAM3: An Accurate Open-Source Library for Visual,
Visual-Inertial and Multi-Map SLAM", 2021). Here the depth of a single frame starts a map.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable
from functools import partial

from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.io.tree import Tree
from slamdepth.loops.look_alikes import View, fits
from slamdepth.loops.meeting import Meeting, Meetings, find_meeting
from slamdepth.mapping.map_keyframe import MapKeyframe
from slamdepth.tracking.map_parts import StoredKeyframes
from slamdepth.tracking.map_tracker import FEWEST_FRAMES, MapTracker, Placed
from slamdepth.types import Frame

log = logging.getLogger(__name__)

_PATIENCE_S = 1.0  # that a map waits for the camera to return
_FIRST_WAIT_S = 0.1  # after the second young map that fails in a row; doubled by each further one
_LOOKED_AT = 2  # maps that a frame or a keyframe is looked for in: those with the most similar places


class Atlas:
    """Tracks the camera in one of several maps.

    Args:
        make: makes an empty map with the given number.

    Attributes:
        maps: all that are kept, in the order of their start.
        active: the one that the camera is in, or was in last.
        joined: how often two maps became one.
        dropped_frames: frames of maps that were not kept.
        finished: the maps of the result, the largest first; empty before the end.
    """

    def __init__(self, make: Callable[[int], MapTracker], config: Config) -> None:
        self._make = make
        self._config = config
        self.maps: list[MapTracker] = []
        self.active = self._new(0)
        self.maps.append(self.active)
        self.joined = 0
        self.dropped_frames = 0
        self.finished: tuple[MapTracker, ...] = ()
        self._started = 1
        self._failed = 0  # young maps in a row that the camera was lost in
        self._lost_since_s: float | None = None
        self._meetings: defaultdict[int, Meetings] = defaultdict(Meetings)

    def track(self, frame: Frame, raw: Features) -> Placed | None:
        """Place a frame in the active map, in another one, or start a map with it.

        Returns:
            None where the camera is lost.
        """
        if not self.active.map.keyframes:
            return self.active.start(frame, raw)
        placed = self.active.track(frame, raw)
        if placed is None:
            if self._lost_since_s is None:
                self._lost_since_s = frame.timestamp_s
            placed = self._find(frame, raw) or self._start(frame, raw)
        if placed is not None:
            self._lost_since_s = None
        if self.active.is_worth_keeping:
            self._failed = 0
        return placed

    @property
    def is_quiet(self) -> bool:
        """Whether all maps wait for nothing, so that :meth:`state` is all there is to know."""
        return bool(self.active.map.keyframes) and all(map_.integration.is_quiet for map_ in self.maps)

    def state(self) -> Tree:
        """Everything the maps remember, for a checkpoint; they must be quiet."""
        by_id = {map_.id: map_ for map_ in self.maps}
        return {
            "maps": [map_.state() for map_ in self.maps],
            "active": self.maps.index(self.active),
            "counts": [self.joined, self.dropped_frames, self._started, self._failed],
            "lost_since_s": self._lost_since_s,
            "meetings": {str(k): found.state() for k, found in self._meetings.items() if k in by_id},
        }

    def restore(self, state: Tree, stored: StoredKeyframes) -> None:
        """Go on from what :meth:`state` gave.

        Args:
            stored: reads images and predictions.
        """
        self.maps = []
        for one in state["maps"]:
            map_ = self._new(one["id"])
            map_.restore(one, stored)
            self.maps.append(map_)
        self.active = self.maps[state["active"]]
        self.joined, self.dropped_frames, self._started, self._failed = state["counts"]
        self._lost_since_s = state["lost_since_s"]
        by_id = {map_.id: map_ for map_ in self.maps}
        for k, found in state["meetings"].items():
            self._meetings[int(k)].restore(found, self.active.map, by_id[int(k)].map)

    def _find(self, frame: Frame, raw: Features) -> Placed | None:
        """Look for the place of a lost frame in the other maps."""
        scores = [(answers[0][1], map_) for map_ in self._others()
                  if (answers := map_.places.query(raw.place_descriptors, top_k=1))]  # fmt: skip
        for _, map_ in sorted(scores, key=lambda pair: -pair[0])[:_LOOKED_AT]:
            placed = map_.find(frame, raw)
            if placed is not None:
                log.info("frame %d: found in map %d", frame.index, map_.id)
                self._activate(map_)
                return placed
        return None

    def _start(self, frame: Frame, raw: Features) -> Placed | None:
        """Start a map with a lost frame, where the camera was lost for long enough."""
        assert self._lost_since_s is not None
        if not self._config.tracking.new_maps:
            return None
        if frame.timestamp_s - self._lost_since_s < self._patience_s():
            return None
        map_ = self._new(self._started)
        map_.view_change.is_large = self.active.view_change.is_large
        placed = map_.start(frame, raw)
        if placed is None:
            return None
        log.info("frame %d: the camera stays lost; map %d starts", frame.index, map_.id)
        self._started += 1
        self._activate(map_)
        return placed

    def _patience_s(self) -> float:
        """How long the active map waits for the camera; a young one that fails may have started badly."""
        if self.active.is_worth_keeping:
            return _PATIENCE_S
        return 0.0 if self._failed == 0 else min(_PATIENCE_S, _FIRST_WAIT_S * 2.0 ** (self._failed - 1))

    def _activate(self, map_: MapTracker) -> None:
        """Go on in another map; the one before is dropped where it is too small to be of use."""
        before = self.active
        before.leave()
        if not before.is_worth_keeping:
            self._failed += 1
            self.dropped_frames += len(before.frames)
            self.maps.remove(before)
        map_.shutter.adopt(before.shutter)
        if map_ not in self.maps:
            self.maps.append(map_)
        self.active = map_
        self._meetings.clear()

    def _new(self, number: int) -> MapTracker:
        map_ = self._make(number)
        map_.relocaliser.others = partial(self._all_but, map_)
        return map_

    def _all_but(self, map_: MapTracker) -> list[MapTracker]:
        return [other for other in self.maps if other is not map_]

    def _others(self) -> list[MapTracker]:
        return self._all_but(self.active)

    def run_stage(self) -> None:
        """Go on with the integration of keyframes, and compare complete ones with the other maps."""
        self.active.run_stage()
        self.meet()

    def meet(self) -> None:
        """Join the active map with one that its latest complete keyframes are in, if there is such a map."""
        for keyframe in self.active.integration.take_complete():
            if self._config.loops.enabled and self._meet(keyframe):
                return

    def _meet(self, keyframe: MapKeyframe) -> bool:
        home = self.active
        if keyframe.id == 0 or len(self.maps) == 1:
            return False
        words = home.places.vector(keyframe.id)
        view, fewest = View.of(keyframe, words), self._config.loops.min_inliers
        others = sorted(self._others(), key=lambda other: -other.places.best_score(words))
        for map_ in others[:_LOOKED_AT]:
            meeting = find_meeting(keyframe, home, map_, fewest)
            if meeting is None:
                continue
            # a place that a third map shows as well tells neither map from that one
            thirds = [other for other in others if other is not map_]
            if any(fits(view, other, fewest) for other in thirds[:_LOOKED_AT]):
                continue
            agreeing = self._meetings[map_.id].add(meeting)
            log.info("map %d: keyframe %d sees a place of map %d", home.id, keyframe.id, map_.id)
            if agreeing and self.join(map_, agreeing):
                return True
        return False

    def add_loaded(self) -> MapTracker:
        """An empty map beside the others, to be filled; it is the active one."""
        self.active = self._new(self._started)
        self._started += 1
        self.maps.append(self.active)
        return self.active

    def join(self, other: MapTracker, meetings: list[Meeting]) -> bool:
        """Make the active map and another one a single map, in the world frame of the older one.

        Args:
            meetings: of keyframes of the active map, which agree.

        Returns:
            False where they would not reproject as one map; then other keyframes must meet.
        """
        home = self.active
        home.integration.run_all()
        similarity = max(meetings, key=lambda meeting: meeting.inliers).similarity
        if not home.integration.loops.may_join(other.map, meetings, similarity):
            self._meetings.pop(other.id, None)
            return False
        log.info("maps %d and %d are joined; a metre of the former is %.3g of the latter",
                 home.id, other.id, similarity.scale)  # fmt: skip
        if other.id < home.id:
            home.move(similarity)
        else:
            other.move(similarity.inverse())
        other.absorb(home, meetings)
        other.id = min(other.id, home.id)
        self.maps.remove(home)
        self.active = other
        self.joined += 1
        self._meetings.clear()
        return True

    def by_size(self) -> list[MapTracker]:
        """The maps to keep, the one with most frames first; never none."""
        ranked = sorted(self.maps, key=lambda map_: -len(map_.frames))
        kept = [map_ for map_ in ranked if len(map_.frames) >= FEWEST_FRAMES] or ranked[:1]
        self.dropped_frames += sum(len(map_.frames) for map_ in ranked[len(kept) :])
        return kept
