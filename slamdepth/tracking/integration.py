# SPDX-License-Identifier: Apache-2.0
"""How a keyframe joins the map: at once, and stage by stage when its depth is there.

A network takes several frames' time for one depth map. So a keyframe joins the map at once with the
landmarks it sees and those that the depth of earlier keyframes gives it, and the window is adjusted. Its own
depth is predicted in another thread; a fixed number of frames later, or earlier where tracking needs it,
landmarks are created from it and the window is adjusted again. Meanwhile other frames may become keyframes.
What happens when depends on the frames alone and not on how fast the threads were, so the trajectory is the
same on every run.

Each stage runs between two frames, so that none of them delays a frame for long.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from slamdepth.backend.bundle_problem import BundleResult
from slamdepth.config import Config
from slamdepth.depth.gravity_consensus import GravityConsensus
from slamdepth.frontend.features import Features
from slamdepth.io.tree import Tree
from slamdepth.loops.closer import LoopCloser
from slamdepth.loops.meeting import Meeting
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.mapping.placement import Placement
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.adjuster import Adjuster
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.keyframe_policy import KeyframePolicy
from slamdepth.tracking.local_mapper import LocalMapper
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.prediction_state import prediction_of, prediction_state
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import GravityInMap, Workers, ready
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

_MAX_WAITING = 2  # keyframes; with three, landmarks are missed that the oldest would have created
_MAX_PENDING = 5  # keyframes whose integration is not complete
_MOSTLY_KNOWN = 0.5  # of the features without a landmark: what is missing is not waited for
_WAITED_FOR = 4  # first keyframes whose depth is waited for: all that follows builds on their landmarks


class _Stage(IntEnum):
    """What is next for a keyframe."""

    SURFACE = 0
    LANDMARKS = 1
    ADJUSTMENT = 2
    LOOP = 3
    ADJUSTMENT_OF_LOOP = 4
    END = 5


@dataclass(eq=False)
class _Waiting:
    """A keyframe whose integration is not complete.

    Attributes:
        frames_left: until its own depth joins the map.
        stage: that is next: landmarks that earlier keyframes gave it are adjusted, its own are created, ...
        is_known: the depth of earlier keyframes gave it most of the landmarks that it lacked.
        neighbours: keyframes that are still to be searched for its landmarks.
        is_in_stage: a stage has begun and has not ended.
        words: its place vector ``(W,)``.
    """

    keyframe: MapKeyframe
    frames_left: int
    stages: Iterator[None] = field(default_factory=lambda: iter(()))
    is_known: bool = False
    stage: _Stage = _Stage.LANDMARKS
    neighbours: list[int] = field(default_factory=list)
    is_in_stage: bool = False
    words: Future[NDArray[np.float32]] | None = None

    @property
    def has_depth(self) -> bool:
        return self.stage > _Stage.LANDMARKS

    @property
    def is_adjusted(self) -> bool:
        return self.stage > _Stage.SURFACE

    @property
    def is_due(self) -> bool:
        return self.frames_left <= 0 or not self.is_adjusted


class KeyframeIntegration:
    """Grows the map with keyframes.

    Attributes:
        mapper, adjuster, loops: the parts of the work, which finishing the map uses again.
        gravity: what the images of this map say of gravity; read it when no keyframe waits.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        map_: Map,
        localiser: Localiser,
        frames: FrameLog,
        shutter: RollingShutter,
        workers: Workers,
        watch: Stopwatch,
    ) -> None:
        self._config = config
        self._map = map_
        self._frames = frames
        self._shutter = shutter
        self._workers = workers
        self._timed = watch.timed
        self.mapper = LocalMapper(camera, config, map_, localiser)
        self.adjuster = Adjuster(camera, config, map_, shutter, localiser.view_change, workers.side)
        self.loops = LoopCloser(camera, config, map_, localiser)
        self._view_change = localiser.view_change
        self._policy = KeyframePolicy(config, map_, localiser.view_change)
        self._waiting: list[_Waiting] = []  # oldest first
        self.gravity = GravityConsensus()
        self._complete: list[MapKeyframe] = []
        self._adjusting: _Waiting | None = None
        self._readout: Future[BundleResult] | None = None

    @property
    def is_quiet(self) -> bool:
        """Whether no keyframe is in the middle of a stage, so that :meth:`state` is all there is to know."""
        return not any(waiting.is_in_stage for waiting in self._waiting)

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint; it must be quiet."""
        assert self.is_quiet
        readout = None if self._readout is None else self._readout.result()
        return {
            "waiting": [self._waiting_state(one) for one in self._waiting],
            "readout": None if readout is None else [readout.readout_s, readout.readout_sigma_s],
            "loops": self.loops.state(),
            "policy": self._policy.state(),
            "gravity": self.gravity.state(),
            "complete": [keyframe.id for keyframe in self._complete],
            "mapper": self.mapper.state(),
        }

    def _waiting_state(self, waiting: _Waiting) -> Tree:
        keyframe = waiting.keyframe
        assert waiting.words is not None
        # what the image says of gravity is added by the time its depth is there
        requested = None if waiting.has_depth else self._workers.depth.requested(keyframe.frame.load())
        return {
            "keyframe": keyframe.id,
            "frames_left": waiting.frames_left,
            "is_known": waiting.is_known,
            "prediction": None if requested is None else prediction_state(requested),
            "stage": int(waiting.stage),
            "neighbours": waiting.neighbours,
            "words": waiting.words.result(),
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self.loops.restore(state["loops"])
        self._policy.restore(state["policy"])
        self.gravity.restore(state["gravity"])
        self._complete = [self._map.keyframes[k] for k in state["complete"]]
        self.mapper.restore(state["mapper"])
        for one in state["waiting"]:
            keyframe = self._map.keyframes[one["keyframe"]]
            if one["prediction"] is not None:
                self._workers.depth.restore(keyframe.frame.load(), prediction_of(one["prediction"]))
            stage, neighbours = _Stage(one["stage"]), list(one["neighbours"])
            waiting = _Waiting(
                keyframe, one["frames_left"], is_known=one["is_known"], stage=stage, neighbours=neighbours
            )
            self._wait(waiting, ready(np.array(one["words"])))
        if state["readout"] is not None:
            self._readout = ready(BundleResult.of_readout(*state["readout"]))

    def wants(self, placement: Placement) -> bool:
        """Whether a frame should become a keyframe; see :class:`KeyframePolicy`."""
        return self._policy.wants(placement)

    @property
    def is_full(self) -> bool:
        """Whether one more keyframe has to wait until the oldest has its depth."""
        unknown = sum(not (waiting.has_depth or waiting.is_known) for waiting in self._waiting)
        return unknown >= _MAX_WAITING or len(self._waiting) >= _MAX_PENDING

    @property
    def awaits_landmarks(self) -> bool:
        """Whether a keyframe has hardly any landmarks until its own depth is there."""
        return any(not (waiting.has_depth or waiting.is_known) for waiting in self._waiting)

    @property
    def awaits_adjustment(self) -> bool:
        """Whether landmarks that earlier keyframes have given are not adjusted yet."""
        return any(not waiting.is_adjusted for waiting in self._waiting)

    @property
    def is_due(self) -> bool:
        """Whether a stage of a waiting keyframe may run."""
        return self._due() is not None

    def _due(self) -> _Waiting | None:
        """Whose stage comes next: the keyframe that is being adjusted, or the oldest that may go on."""
        if self._adjusting is not None:
            return self._adjusting
        return next((waiting for waiting in self._waiting if waiting.is_due), None)

    @property
    def is_adjusting(self) -> bool:
        """Whether an adjustment is in progress, during which landmark ids must not change."""
        return self._adjusting is not None

    def count_frame(self) -> None:
        """Count a frame; a keyframe's own depth joins the map after ``tracking.depth_delay`` of them."""
        for waiting in self._waiting:
            waiting.frames_left -= 1

    def add_keyframe(
        self, frame: Frame, features: Features, placement: Placement, velocity: Floats
    ) -> MapKeyframe:
        """Put a frame into the map and request its depth; the stages of its integration follow.

        Args:
            features: corrected for the rolling shutter.
            velocity: ``(6,)`` m/s and rad/s, camera frame.
        """
        depth = self._workers.depth
        depth.request(frame, GravityInMap(self.gravity, placement.T_camera_world[:3, :3].T))
        with self._timed("mapping"):
            keyframe = self._map.add_keyframe(
                frame, features, placement.T_camera_world, placement.landmark_ids, velocity
            )
        self._policy.keyframe_made()
        delay = 0 if depth.is_instant(frame) else self._config.tracking.depth_delay
        is_waited_for = len(self._map.keyframes) <= _WAITED_FOR or self._view_change.is_large
        waiting = _Waiting(keyframe, delay)
        if delay > 0 and not (is_waited_for or self._view_change.doubts_depth):
            self._give_surface(waiting)
        self._wait(waiting, self._workers.side.submit(self.loops.describe, features))
        if is_waited_for:
            self.run_all()
        return keyframe

    def _give_surface(self, waiting: _Waiting) -> None:
        """Create landmarks from the depth of earlier keyframes."""
        keyframe = waiting.keyframe
        with self._timed("surface"):
            known = self.mapper.add_surface(keyframe)
            if known > 0:
                first_half = self.mapper.neighbours(keyframe)[::2]
                self.mapper.search(keyframe, first_half, may_fuse=not self.is_adjusting)
        if known >= _MOSTLY_KNOWN:
            waiting.is_known, waiting.stage = True, _Stage.SURFACE

    def _wait(self, waiting: _Waiting, words: Future[NDArray[np.float32]]) -> None:
        """Let a keyframe wait for its stages."""
        waiting.words, waiting.stages = words, self._stages(waiting, words)
        self._waiting.append(waiting)

    def _stages(self, waiting: _Waiting, words: Future[NDArray[np.float32]]) -> Iterator[None]:
        """What follows, from the keyframe's stage on; a frame is tracked at each ``yield``."""
        keyframe = waiting.keyframe
        if waiting.stage == _Stage.SURFACE:
            yield from self._search_and_adjust(waiting, self.mapper.neighbours(keyframe)[1::2])
            waiting.stage = _Stage.LANDMARKS
            yield
        if waiting.stage == _Stage.LANDMARKS:
            prediction = self._workers.depth.take(keyframe.frame.load())
            with self._timed("mapping"):
                self._update_velocity(keyframe)
                self.mapper.add_depth(keyframe, prediction)
                neighbours = self.mapper.neighbours(keyframe)
                self.mapper.search(keyframe, neighbours[::2])
            waiting.stage, waiting.neighbours = _Stage.ADJUSTMENT, neighbours[1::2]
            self._policy.landmarks_created()
            yield
        if waiting.stage == _Stage.ADJUSTMENT:
            yield from self._search_and_adjust(waiting, waiting.neighbours)
            waiting.stage = _Stage.LOOP
            yield
        if waiting.stage == _Stage.LOOP:
            with self._timed("loops"):
                closure = self.loops.close(keyframe, words.result())
            waiting.stage = _Stage.END if closure is None else _Stage.ADJUSTMENT_OF_LOOP
            if closure is not None:
                yield
        if waiting.stage == _Stage.ADJUSTMENT_OF_LOOP:  # tie its two sides together by what both see
            yield from self._search_and_adjust(waiting, self.mapper.neighbours(keyframe))
            waiting.stage = _Stage.END
            yield
        with self._timed("mapping"):
            self._map.cull(keyframe)
            self._map.spill_images()
        self._complete.append(keyframe)

    def _search_and_adjust(self, waiting: _Waiting, neighbours: list[int]) -> Iterator[None]:
        """Search the keyframe's landmarks in ``neighbours`` and adjust the window in the side thread."""
        keyframe, waiting.is_in_stage = waiting.keyframe, True
        with self._timed("mapping"):
            self.mapper.search(keyframe, neighbours)
        with self._timed("bundle"):
            adjustment = self.adjuster.begin_window(keyframe)
        self._adjusting = None if adjustment is None else waiting
        yield
        yield  # two frames' time for the side thread
        self._take_readout()
        with self._timed("bundle"):
            if adjustment is not None:
                self.adjuster.complete(adjustment)
                self._adjusting = None
            if self._shutter.is_due(keyframe.id + 1):
                self._readout = self.adjuster.begin_readout()
        waiting.is_in_stage = False

    def run_all(self) -> bool:
        """Complete the integration of all waiting keyframes; False where none waits."""
        self._take_readout()
        if not self._waiting:
            return False
        while self._waiting:
            self._run(self._adjusting or self._waiting[0])
        return True

    def run_until_landmarks(self) -> None:
        """Run stages until one more waiting keyframe has its own depth."""
        while self._waiting:
            oldest = self._adjusting or self._waiting[0]
            had_depth = oldest.has_depth
            self._run(oldest)
            if oldest.has_depth and not had_depth:
                return

    def run_until_adjusted(self) -> None:
        """Run stages until one more keyframe is adjusted with the landmarks that earlier ones gave it."""
        given = next((waiting for waiting in self._waiting if not waiting.is_adjusted), None)
        while given is not None and not given.is_adjusted:
            self._run(self._adjusting or given)

    def run_stage(self) -> None:
        """Run the stage that is due."""
        waiting = self._due()
        if waiting is not None:
            self._run(waiting)

    def _run(self, waiting: _Waiting) -> None:
        if next(waiting.stages, _COMPLETE) is _COMPLETE:
            self._waiting.remove(waiting)

    def take_complete(self) -> list[MapKeyframe]:
        """The keyframes whose integration was completed since this was asked last, oldest first."""
        complete, self._complete = self._complete, []
        return complete

    def join(self, other: KeyframeIntegration, first: int, meetings: Sequence[Meeting]) -> None:
        """Go on in the place of the integration of a map that this map has absorbed; no keyframe waits.

        Args:
            first: number of the other map's first keyframe in this map.
            meetings: what the two maps were joined by.
        """
        self.gravity.absorb(other.gravity)
        self.mapper.absorb(other.mapper)
        self.loops.join(other.loops, first, meetings)
        self._policy.keyframe_made()
        with self._timed("mapping"):
            for meeting in meetings:
                self.mapper.search(meeting.keyframe, self.mapper.neighbours(meeting.keyframe))
        with self._timed("bundle"):
            for meeting in meetings:
                self.adjuster.adjust_window(meeting.keyframe)

    def _update_velocity(self, keyframe: MapKeyframe) -> None:
        """The frames after a keyframe say how it moved, too."""
        velocity = self._frames.velocity_at(keyframe.id)
        if velocity is not None:
            self._map.set_velocity(keyframe, velocity)
        if self._shutter.is_active:
            self._shutter.correct_keyframe(keyframe)

    def _take_readout(self) -> None:
        """Take over the readout time that the side thread estimated, if it was asked."""
        if self._readout is None:
            return
        with self._timed("bundle"):
            has_changed = self.adjuster.complete_readout(self._readout)
            self._readout = None
            if has_changed:
                self._shutter.correct_keyframes()


_COMPLETE = object()
