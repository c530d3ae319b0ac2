# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

import logging
from functools import partial

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.errors import TrackingError
from slamdepth.frontend.features import Features
from slamdepth.geometry import invert
from slamdepth.mapping.landmarks import LandmarkMap
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking.between_frames import BetweenFrames
from slamdepth.tracking.checks import check_frame, model_for
from slamdepth.tracking.depth_thread import DepthThread
from slamdepth.tracking.finder import Finder
from slamdepth.tracking.finish import build_reconstruction, optimise_everything
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.held import HeldBytes, held_bytes
from slamdepth.tracking.keyframes import Keyframes, Moved
from slamdepth.tracking.local_mapper import LocalMapper
from slamdepth.tracking.localiser import Localiser, Placement
from slamdepth.tracking.loop_closer import LoopCloser
from slamdepth.tracking.map_adjuster import MapAdjuster
from slamdepth.tracking.motion import Motion
from slamdepth.tracking.prepare import Preparation, Prepared, load_libraries
from slamdepth.tracking.rescue import CloudRescue
from slamdepth.tracking.shutter import Shutter
from slamdepth.tracking.side_thread import SideThread
from slamdepth.tracking.stopwatch import Stopwatch
from slamdepth.tracking.threads import single_threaded
from slamdepth.types import Camera, DepthPrediction, Frame, StepResult, TrackingStatus

log = logging.getLogger(__name__)

_SETTLED = 0.8  # of a frame's points agree still; of frames that follow one another 0.92 and more


class Tracker:
    """Monocular SLAM with a depth prior: feed frames to :meth:`step`, then :meth:`finish`.

    Example:
        >>> tracker = Tracker(camera, depth_model=create_depth_model("dinov2"))  # doctest: +SKIP
        >>> for frame in frames:  # doctest: +SKIP
        ...     result = tracker.step(frame)
        >>> reconstruction = tracker.finish()  # doctest: +SKIP

    Args:
        camera: the camera of every frame.
        depth_model: where the depth of keyframes comes from; None builds the one that
            ``config.depth.name`` names.
        config: settings; None takes the defaults.

    Raises:
        ConfigError: a feature or depth model of that name does not exist.
        WeightsError: the depth model's weights are not there.
    """

    def __init__(
        self, camera: Camera, depth_model: DepthModel | None = None, config: Config | None = None
    ) -> None:
        self.camera = camera
        self.config = config or Config()
        self._depth = DepthThread(
            model_for(depth_model, self.config), with_uncertainty=self.config.depth.uncertainty
        )
        self._preparation = Preparation(camera, self.config.features)
        self._watch = Stopwatch()
        self._map = LandmarkMap()
        self._localiser = Localiser(camera, self.config, self._map, self._preparation.levels)
        self._shutter = Shutter(camera, self.config.shutter, self._map)
        self._side = SideThread()
        self._adjuster = MapAdjuster(camera, self.config, self._map, self._shutter, self._side)
        self._mapper = LocalMapper(camera, self.config, self._map, self._localiser, self._adjuster)
        self._loops = LoopCloser(self.config, self._map, self._localiser)
        self._log = FrameLog(camera, self._map)
        self._keyframes = Keyframes(
            self.config,
            self._map,
            self._mapper,
            self._adjuster,
            self._loops,
            self._log,
            self._depth,
            self._shutter,
            self._watch,
            self._side,
        )
        self._motion = Motion()
        self._finder = Finder(
            self.config,
            self._map,
            self._localiser,
            self._loops.places,
            CloudRescue(camera, self.config, self._map),
            self._depth,
            self._motion,
            self._join,
            self._depth_of,
        )
        self._between = BetweenFrames()
        self._frames = 0
        self._finished = False
        load_libraries()

    def prepare(self, frame: Frame) -> Prepared:
        """What :meth:`step` needs of a frame and can be found out ahead, in another thread, say."""
        return self._preparation(frame)

    def step(self, frame: Frame, prepared: Prepared | None = None) -> StepResult:
        """Place the next frame.

        What the map needs before the frame after it goes on in a thread when this returns.

        Args:
            frame: later than all before; taken by ``self.camera``.
            prepared: what :meth:`prepare` gave for it; None prepares it here. The result
                is the same.

        Returns:
            Its pose and what was done; ``T_world_camera`` is None where it was lost.

        Raises:
            TrackingError: the tracker has finished, or time does not increase.
            CameraError: the frame was taken by another camera.
        """
        check_frame(frame, self.camera, self._motion.last_time_s, self._finished)
        with single_threaded():
            prepared = prepared or self.prepare(frame)
            self._between.wait()
            result = self._step(frame, prepared)
        self._motion.last_time_s = frame.timestamp_s
        self._watch.next_frame()
        if self._map.keyframes:
            self._keyframes.count_frame()
            if self._keyframes.is_due:
                self._between.begin(partial(self._join, stages=1))
        return result

    def _step(self, frame: Frame, prepared: Prepared) -> StepResult:
        self._frames += 1
        plain = prepared.features
        self._watch.add("features", prepared.took_ms)
        if not self._map.keyframes:
            return self._start(frame, plain)
        if not self._keyframes.is_adjusting:
            self._forget_points()
        with self._watch.timed("tracking"):
            features = self._still(frame, plain)
            placement, status = self._finder.place(frame, features)
            if placement is None:
                return self._result(frame, TrackingStatus.LOST, None, False)
            features, placement = self._settle(frame, plain, features, placement)
        is_found_anew = self._motion.last is None
        is_keyframe = self._keyframes.wants(placement) and self._depth.has_depth(frame)
        if is_keyframe and self._keyframes.is_full:
            # the depth that is on its way longest comes first
            placement = self._place_again(features, placement)
            is_keyframe = self._keyframes.wants(placement)
        if is_keyframe:
            before = placement
            placement = self._make_keyframe(frame, features, placement)
            self._motion.remember(frame.timestamp_s, before, placement)
        else:
            self._motion.remember(frame.timestamp_s, placement, placement)
        self._log.add(frame.timestamp_s, plain, placement, is_keyframe, is_found_anew=is_found_anew)
        return self._result(frame, status, placement, is_keyframe)

    def _still(self, frame: Frame, plain: Features) -> Features:
        """Features freed from the rolling shutter by the velocity of the last frames."""
        if not self._shutter.rolls or self._motion.last is None:
            return plain
        T_guess = self._motion.guess(frame.timestamp_s)
        usual = self._shutter.usual_inverse_depth(T_guess, self._motion.last.point_ids)
        velocity = self._motion.velocity(frame.timestamp_s, T_guess)
        return self._shutter.correct(plain, velocity, np.full(len(plain), usual))

    def _settle(
        self, frame: Frame, plain: Features, features: Features, placement: Placement
    ) -> tuple[Features, Placement]:
        """The same by the velocity of this very frame, and the frame placed by that.

        Where its points contradict that velocity, the recording was cut and the camera did not move there.
        """
        if not self._shutter.rolls or self._motion.last is None:
            return features, placement
        T = placement.T_camera_world
        inverse = self._shutter.inverse_depth(T, placement.point_ids)
        corrected = self._shutter.correct(plain, self._motion.velocity(frame.timestamp_s, T), inverse)
        settled = self._localiser.settle(corrected, placement)
        if settled.inliers >= _SETTLED * placement.inliers:
            return corrected, settled
        self._motion.last = None
        return plain, self._localiser.settle(plain, placement)

    def _join(self, *, until_born: bool = False, stages: int | None = None) -> Moved | None:
        """Let waiting keyframes have their depth, see ``Keyframes.join``, and follow the map."""
        moved = self._keyframes.join(until_born=until_born, stages=stages)
        self._motion.follow(moved)
        return moved

    def _forget_points(self) -> None:
        """Let the map give away the rows of points that are gone; nobody else remembers rows by now."""
        now = self._map.compact()
        if now is not None:
            self._log.renumber(now)
            self._motion.renumber(now)

    def _place_again(self, features: Features, placement: Placement) -> Placement:
        """Place a frame in the map that its keyframe's depth has just made larger."""
        moved = self._join(until_born=True)
        assert moved is not None
        rows = self._map.resolve(placement.point_ids)
        carried = Placement(moved.carry(placement.T_camera_world), rows)
        with self._watch.timed("tracking"):
            return self._localiser.refine_in_local_map(features, carried) or carried

    def _make_keyframe(self, frame: Frame, features: Features, placement: Placement) -> Placement:
        velocity = self._motion.velocity(frame.timestamp_s, placement.T_camera_world)
        keyframe = self._keyframes.make(frame, features, placement, velocity)
        return Placement(keyframe.T_camera_world.copy(), keyframe.point_ids.copy())

    def _start(self, frame: Frame, features: Features) -> StepResult:
        need = self.config.tracking.min_inliers
        if len(features) < need or not self._depth.has_depth(frame):
            return self._result(frame, TrackingStatus.INITIALISING, None, False)
        if self._mapper.count_births(features, self._depth_of(frame)) < need:
            return self._result(frame, TrackingStatus.INITIALISING, None, False)
        empty = Placement(np.eye(4), np.full(len(features), -1, dtype=np.int64))
        placement = self._make_keyframe(frame, features, empty)
        self._motion.remember(frame.timestamp_s, placement, placement)
        self._log.add(frame.timestamp_s, features, placement, True)
        return self._result(frame, TrackingStatus.TRACKING, placement, True)

    def _result(
        self, frame: Frame, status: TrackingStatus, placement: Placement | None, is_keyframe: bool
    ) -> StepResult:
        return StepResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=status,
            T_world_camera=None if placement is None else invert(placement.T_camera_world),
            inliers=0 if placement is None else placement.inliers,
            is_keyframe=is_keyframe,
            keyframes=len(self._map.keyframes),
            loop_closures=self._loops.count,
            timings_ms=self._watch.frame_ms,
        )

    def _depth_of(self, frame: Frame) -> DepthPrediction:
        with self._watch.timed("depth"):
            return self._depth.take(frame)

    def held(self) -> HeldBytes:
        """How much memory keyframes, points and frames take by now."""
        self._between.wait()
        return held_bytes(self._map, self._log, self._keyframes.store)

    def finish(self) -> Reconstruction:
        """Adjust the whole map, make it metric, place every frame in it, and hand it over.

        Raises:
            TrackingError: it was called before, or no frame could be placed.
        """
        if self._finished:
            raise TrackingError("this tracker has finished already")
        self._between.wait()
        if not self._map.keyframes:
            raise TrackingError("no frame could be placed: too few features, or no depth")
        self._finished = True
        self._watch.next_frame()
        with single_threaded():
            self._join()
            with self._watch.timed("final"):
                notes, votes = optimise_everything(
                    self._map, self._mapper, self._adjuster, self._log, self._shutter, self.config
                )
            made = build_reconstruction(
                self._map,
                self._mapper,
                self._log,
                self._shutter,
                refine_frames=self.config.bundle.final,
                frames_total=self._frames,
                loop_closures=self._loops.count,
                relocalisations=self._finder.relocalisations,
                registrations=self._finder.rescues,
                timings_ms=self._watch.mean_ms(),
                timing_calls=self._watch.calls(),
                notes=notes,
                scale_votes=votes,
                gravity_w=self._depth.down_w(),
            )
            self._depth.close()
            self._side.close()
            self._between.close()
            return made
