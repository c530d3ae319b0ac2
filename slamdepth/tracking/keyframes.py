# SPDX-License-Identifier: Apache-2.0
"""What happens when a frame becomes a keyframe: at once, and when its depth is there.

A network takes several frames' time for one depth map. So the keyframe joins the map at
once with the points it already knows, its depth is predicted in a thread of its own, and
a fixed number of frames later, or earlier where tracking needs it, new points are born
and the window is adjusted. Meanwhile another frame may become a keyframe. When what
happens depends on the frames alone and not on how fast the network was, so the trajectory
is the same on every machine.

What follows the depth is spread over several frames, so that none of them takes long, and is done
before the frame is placed, see :mod:`slamdepth.tracking.between_frames`. The window is
adjusted in a thread beside, from a copy, and taken over two frames later; once more where a loop was closed.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.backend.bundle import BundleResult
from slamdepth.config import Config
from slamdepth.frontend.features import Features
from slamdepth.geometry import orthonormalised
from slamdepth.mapping.keyframe_store import KeyframeStore
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracking.depth_thread import DepthThread
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.keyframe_rule import KeyframeRule
from slamdepth.tracking.local_mapper import LocalMapper
from slamdepth.tracking.localiser import Placement
from slamdepth.tracking.loop_closer import LoopCloser
from slamdepth.tracking.map_adjuster import Adjustment, MapAdjuster
from slamdepth.tracking.shutter import Shutter
from slamdepth.tracking.side_thread import SideThread
from slamdepth.tracking.stopwatch import Stopwatch
from slamdepth.types import Frame
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MOST_WAITING = 2  # keyframes; with three, points are missed that the oldest would have given birth to
_WAITED_FOR = 4  # first keyframes whose depth is waited for: all that follows stands on their points


@dataclass
class _Waiting:
    keyframe: MapKeyframe
    frames_left: int
    words: Future[NDArray[np.float32]]
    stages: list[_Stage]  # still to come
    is_born: bool = False
    neighbours: list[int] = field(default_factory=list)
    adjustment: Adjustment | None = None


_Stage = Callable[[_Waiting], "Floats | None"]
"""Returns what the metres of each keyframe were multiplied by, where a loop was closed."""


@dataclass
class Moved:
    """How the map moved around a keyframe."""

    keyframe: MapKeyframe
    T_world_keyframe_before: Floats
    scale: float = 1.0

    def carry(self, T_camera_world: Floats) -> Floats:
        """A pose ``(4, 4)`` measured before, in the map as it is now."""
        T_camera_keyframe = T_camera_world @ self.T_world_keyframe_before
        T_camera_keyframe[:3, 3] *= self.scale
        # a keyframe's pose comes from a carried one: left alone, rounding would double with each
        return orthonormalised(T_camera_keyframe @ self.keyframe.T_camera_world)


class Keyframes:
    """Grows the map with keyframes.

    Args:
        watch: measures the stages.

    Attributes:
        store: where their images lie.
    """

    def __init__(
        self,
        config: Config,
        landmarks: LandmarkMap,
        mapper: LocalMapper,
        adjuster: MapAdjuster,
        loops: LoopCloser,
        frames: FrameLog,
        depth: DepthThread,
        shutter: Shutter,
        watch: Stopwatch,
        side: SideThread,
    ) -> None:
        self._config = config
        self._map = landmarks
        self._mapper = mapper
        self._adjuster = adjuster
        self._loops = loops
        self._log = frames
        self._depth = depth
        self._shutter = shutter
        self._timed = watch.timed
        self.store = KeyframeStore(config.map.keyframe_memory_mib)
        self._side = side
        self._rule = KeyframeRule(config, landmarks)
        self._waiting: list[_Waiting] = []  # oldest first
        self._readout: Future[BundleResult] | None = None

    def wants(self, placement: Placement) -> bool:
        """Whether a frame should become a keyframe; see :class:`KeyframeRule`."""
        return self._rule.wants(placement)

    @property
    def is_full(self) -> bool:
        """Whether one more keyframe has to wait until the oldest has given birth to its points."""
        return sum(not waiting.is_born for waiting in self._waiting) >= _MOST_WAITING

    @property
    def is_due(self) -> bool:
        """Whether the oldest waiting keyframe's time has come."""
        return bool(self._waiting) and self._waiting[0].frames_left <= 0

    @property
    def is_adjusting(self) -> bool:
        """Whether an adjustment is on its way, which remembers rows of points."""
        return bool(self._waiting) and self._waiting[0].adjustment is not None

    def count_frame(self) -> None:
        """Tell that another frame has come."""
        for waiting in self._waiting:
            waiting.frames_left -= 1

    def make(self, frame: Frame, features: Features, placement: Placement, velocity: Floats) -> MapKeyframe:
        """Put a frame into the map; its depth follows ``tracking.depth_delay`` frames later."""
        self._depth.ask(frame, placement.T_camera_world[:3, :3].T)
        with self._timed("mapping"):
            keyframe = self._mapper.insert(
                frame, features, placement.T_camera_world, placement.point_ids, velocity
            )
        self._rule.keyframe_made()
        delay = 0 if self._depth.is_instant(frame) else self._config.tracking.depth_delay
        words = self._side.ask(self._loops.describe, keyframe.features)
        stages: list[_Stage] = [
            self._give_birth,
            self._search_on,
            self._let_adjust,
            self._take_over,
            self._close_loops,
        ]
        self._waiting.append(_Waiting(keyframe, delay, words, stages))
        if len(self._map.keyframes) <= _WAITED_FOR:
            self.join()
        return keyframe

    def join(self, *, until_born: bool = False, stages: int | None = None) -> Moved | None:
        """Go on with the waiting keyframes, oldest first: by default until none waits.

        Args:
            until_born: only until one more has given birth to its points.
            stages: at most so many stages are done.

        Returns:
            How the map moved around the newest keyframe; None where no keyframe waits.
        """
        if stages is None and not until_born:
            self._learn_readout()
        if not self._waiting:
            return None
        anchor = self._map.keyframes[-1]
        moved = Moved(anchor, anchor.T_world_camera)
        done = 0
        while self._waiting and done != stages:
            oldest = self._waiting[0]
            was_born = oldest.is_born
            scales = self._next_stage(oldest)
            if scales is not None:
                moved.scale *= float(scales[anchor.id])
            done += 1
            if until_born and oldest.is_born and not was_born:
                break
        return moved

    def _next_stage(self, waiting: _Waiting) -> Floats | None:
        """One stage of what follows a keyframe's depth.

        Returns:
            ``(K,)`` what the metres of each keyframe were multiplied by, where a loop was closed.
        """
        scales = waiting.stages.pop(0)(waiting)
        if not waiting.stages:
            del self._waiting[0]
        return scales

    def _give_birth(self, waiting: _Waiting) -> None:
        keyframe = waiting.keyframe
        with self._timed("depth"):
            prediction = self._depth.take(keyframe.frame.load())
        with self._timed("mapping"):
            self._follow_motion(keyframe)
            self._mapper.give_birth(keyframe, prediction)
            waiting.neighbours = self._mapper.neighbours(keyframe)
            self._mapper.search(keyframe, waiting.neighbours[::2])
        waiting.is_born = True
        self._rule.points_born()

    def _search_on(self, waiting: _Waiting) -> None:
        self._search_and_adjust(waiting, waiting.neighbours[1::2])

    def _search_and_adjust(self, waiting: _Waiting, neighbours: list[int]) -> None:
        with self._timed("mapping"):
            self._mapper.search(waiting.keyframe, neighbours)
        with self._timed("bundle"):
            waiting.adjustment = self._mapper.begin_window(waiting.keyframe)

    def _follow_motion(self, keyframe: MapKeyframe) -> None:
        """Use that the frames after the keyframe tell how it moved."""
        velocity = self._log.velocity_at(keyframe.id)
        if velocity is not None:
            keyframe.velocity = velocity
        if self._shutter.rolls:
            self._shutter.correct_keyframe(keyframe)

    def _let_adjust(self, waiting: _Waiting) -> None:
        """Leave the thread beside a frame's time."""

    def _take_over(self, waiting: _Waiting) -> None:
        self._learn_readout()
        with self._timed("bundle"):
            if waiting.adjustment is not None:
                self._adjuster.complete(waiting.adjustment)
                waiting.adjustment = None
            if self._shutter.is_due(waiting.keyframe.id + 1):
                self._readout = self._adjuster.begin_readout()

    def _learn_readout(self) -> None:
        """Take over what the thread beside found out of the shutter, should it have been asked."""
        if self._readout is None:
            return
        with self._timed("bundle"):
            is_new = self._adjuster.complete_readout(self._readout)
            self._readout = None
            if is_new:
                self._shutter.correct_keyframes()

    def _close_loops(self, waiting: _Waiting) -> Floats | None:
        keyframe = waiting.keyframe
        with self._timed("loops"):
            self._loops.add(keyframe, waiting.words.result())
            correction = self._loops.close(keyframe)
        if correction is None:
            self._tidy(waiting)
            return None
        self._log.rescale(correction.scales)
        waiting.stages += [self._search_anew, self._let_adjust, self._take_over, self._tidy]
        return correction.scales

    def _search_anew(self, waiting: _Waiting) -> None:
        """Tie the two sides of a loop together by what both see."""
        self._search_and_adjust(waiting, self._mapper.neighbours(waiting.keyframe))

    def _tidy(self, waiting: _Waiting) -> None:
        with self._timed("mapping"):
            self._mapper.cull(waiting.keyframe)
            self.store.tidy(self._map.keyframes)
