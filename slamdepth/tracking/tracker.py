# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import TracebackType

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.depth.metric import metric_model
from slamdepth.errors import TrackingError
from slamdepth.frontend.features import Features
from slamdepth.frontend.preparation import Preparation, Prepared
from slamdepth.geometry import invert, orthonormalised
from slamdepth.mapping.map import Map
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.finish import build_reconstruction, optimise_map
from slamdepth.tracking.frame_log import FrameLog, check_frame
from slamdepth.tracking.integration import KeyframeIntegration
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.motion import MotionModel
from slamdepth.tracking.relocaliser import Relocaliser
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.workers import DepthWorker, Workers
from slamdepth.types import Camera, Frame, RunStatistics, StepResult, TrackingStatus

_SAME_MOTION = 0.8  # of a frame's landmarks agree still; of consecutive frames 0.92 and more

_STATUS = {
    PlacedBy.MOTION: TrackingStatus.TRACKING,
    PlacedBy.LAST_KEYFRAME: TrackingStatus.TRACKING,
    PlacedBy.PLACE: TrackingStatus.RELOCALISED,
    PlacedBy.REGISTRATION: TrackingStatus.REGISTERED,
}


class Tracker:
    """Monocular SLAM with a depth prior: feed frames to :meth:`step`, then :meth:`finish`.

    Example:
        >>> with Tracker(camera, depth_model=create_depth_model("dinov2")) as tracker:  # doctest: +SKIP
        ...     for frame in frames:
        ...         result = tracker.step(frame)
        ...     reconstruction = tracker.finish()

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
        self.config = config = config or Config()
        model = metric_model(depth_model, config)
        self._prepare = Preparation(camera, config.features)
        self._watch = Stopwatch()
        self._workers = Workers(DepthWorker(model, self._watch, with_uncertainty=config.depth.uncertainty))
        self._map = Map(config.map.keyframe_memory_mib)
        self._frames = FrameLog(camera, self._map)
        self._motion = MotionModel()
        self._shutter = RollingShutter(camera, config.shutter, self._map)
        self._localiser = Localiser(camera, config, self._map, self._prepare.levels)
        self._integration = KeyframeIntegration(
            camera,
            config,
            self._map,
            self._localiser,
            self._frames,
            self._shutter,
            self._workers,
            self._watch,
        )
        self._relocaliser = Relocaliser(
            camera,
            config,
            self._map,
            self._localiser,
            self._integration.loops.places,
            self._workers.depth,
        )
        self._steps = 0
        self._placed_by: Counter[PlacedBy] = Counter()
        self._finished = False
        _load_libraries()

    def prepare(self, frame: Frame) -> Prepared:
        """The features of a frame, which another thread may find ahead of :meth:`step`."""
        return self._prepare(frame)

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
            raw = self._features(frame, prepared)
            self._workers.between.wait()
            result = self._track(frame, raw) if self._map.keyframes else self._initialise(frame, raw)
        self._motion.last_time_s = frame.timestamp_s
        self._watch.next_frame()
        if self._map.keyframes:
            self._integration.count_frame()
            if self._integration.is_due:
                self._workers.between.begin(self._run_stage)
        return result

    def _run_stage(self) -> None:
        """Go on with the integration of keyframes before the next frame."""
        self._integration.run_stage()
        self._motion.follow_map()

    def _features(self, frame: Frame, prepared: Prepared | None) -> Features:
        prepared = prepared or self._prepare(frame)
        self._watch.add("features", prepared.took_ms)
        self._steps += 1
        return prepared.features

    def _initialise(self, frame: Frame, features: Features) -> StepResult:
        """Start the map with a frame whose depth creates enough landmarks."""
        need = self.config.tracking.min_inliers
        depth = self._workers.depth
        if len(features) < need or not depth.has_depth(frame):
            return self._result(frame, TrackingStatus.INITIALISING)
        if self._integration.mapper.count_creatable(features, depth.take(frame)) < need:
            return self._result(frame, TrackingStatus.INITIALISING)
        origin = Placement(np.eye(4), np.full(len(features), -1, dtype=np.int64))
        placement = self._add_keyframe(frame, features, origin)
        self._frames.add(frame.timestamp_s, features, placement, is_keyframe=True)
        return self._result(frame, TrackingStatus.TRACKING, placement, is_keyframe=True)

    def _track(self, frame: Frame, raw: Features) -> StepResult:
        """Place a frame in the map, and make it a keyframe where the view has moved on."""
        self._compact()
        with self._watch.timed("tracking"):
            features = self._shutter.correct_by_motion(raw, self._motion, frame.timestamp_s)
            placement = self._place(frame, features)
            if placement is None:
                self._lose()
                return self._result(frame, TrackingStatus.LOST)
            status = _STATUS[placement.placed_by]
            features, placement = self._correct_by_pose(frame, raw, features, placement)
        follows_motion = self._motion.is_known
        is_keyframe = self._integration.wants(placement) and self._workers.depth.has_depth(frame)
        if is_keyframe and self._integration.is_full:
            placement = self._place_in_grown_map(features, placement)
            is_keyframe = self._integration.wants(placement)
        if is_keyframe:
            placement = self._add_keyframe(frame, features, placement)
        else:
            self._motion.advance(frame.timestamp_s, placement.T_camera_world)
            self._motion.anchor(placement, self._map.keyframes[-1])
        self._frames.add(frame.timestamp_s, raw, placement, is_keyframe, follows_motion=follows_motion)
        return self._result(frame, status, placement, is_keyframe)

    def _place(self, frame: Frame, features: Features) -> Placement | None:
        """Every way to place a frame, the cheapest first; None where it is lost."""
        T_guess = None
        placement = None
        newest = None
        if self._motion.is_known:
            placement = self._track_motion(frame, features)
            if placement is None and self._integration.run_all():  # their landmarks may be what is missing
                self._motion.follow_map()
                placement = self._track_motion(frame, features)
            newest = len(self._map.keyframes) - 1
            placement = placement or self._localiser.from_keyframe(features, newest)
            T_guess = self._motion.predict(frame.timestamp_s)
        else:
            self._relocaliser.schedule.count_frame()
        placement = placement or self._relocaliser.by_place(features, without=newest)
        placement = placement or self._relocaliser.by_registration(frame, features, T_guess)
        if placement is not None:
            self._placed_by[placement.placed_by] += 1
            self._map.count_views(placement.expected_ids, placement.found_ids)
            if placement.placed_by in (PlacedBy.LAST_KEYFRAME, PlacedBy.PLACE):
                self._motion.forget()  # found by its view alone: the recording may have been cut
        return placement

    def _track_motion(self, frame: Frame, features: Features) -> Placement | None:
        recent = self._map.resolve(self._motion.landmark_ids)
        T_guess = self._motion.predict(frame.timestamp_s)
        return self._localiser.track(features, T_guess, np.unique(recent[recent >= 0]))

    def _lose(self) -> None:
        """Forget the motion; where it led to last is tried again for some frames."""
        if self._motion.is_known:
            self._relocaliser.schedule.start(self._motion.T_camera_world, self._motion.step)
        self._motion.forget()

    def _correct_by_pose(
        self, frame: Frame, raw: Features, features: Features, placement: Placement
    ) -> tuple[Features, Placement]:
        """Correct the rolling shutter by the velocity of this very frame, and place the frame by that.

        Where its landmarks contradict that velocity, the recording was cut and the camera did not move there.
        """
        corrected = self._shutter.correct_by_pose(raw, self._motion, frame.timestamp_s, placement)
        if corrected is None:
            return features, placement
        refined = self._localiser.reoptimise(corrected, placement)
        if refined.inliers >= _SAME_MOTION * placement.inliers:
            return corrected, refined
        self._motion.forget()
        return raw, self._localiser.reoptimise(raw, placement)

    def _place_in_grown_map(self, features: Features, placement: Placement) -> Placement:
        """Place a frame again, once the keyframe that waits longest has created its landmarks."""
        pose = AnchoredPose.of(placement.T_camera_world, self._map.keyframes[-1])
        self._integration.run_until_landmarks()
        self._motion.follow_map()
        carried = replace(
            placement,
            T_camera_world=orthonormalised(pose.T_camera_world),
            landmark_ids=self._map.resolve(placement.landmark_ids),
        )
        with self._watch.timed("tracking"):
            refined = self._localiser.refine_in_local_map(features, carried)
        if refined is None:
            return carried
        self._map.count_views(refined.expected_ids, refined.found_ids)
        return refined

    def _add_keyframe(self, frame: Frame, features: Features, measured: Placement) -> Placement:
        """Make a frame a keyframe; returns its placement in the map, which may have moved."""
        velocity = self._motion.velocity(frame.timestamp_s, measured.T_camera_world)
        self._motion.advance(frame.timestamp_s, measured.T_camera_world)
        keyframe = self._integration.add_keyframe(frame, features, measured, velocity)
        placement = Placement(keyframe.T_camera_world, keyframe.landmark_ids.copy())
        self._motion.anchor(placement, keyframe)
        return placement

    def _compact(self) -> None:
        """Let the map give away ids of landmarks that are gone, unless an adjustment remembers ids."""
        ids_now = None if self._integration.is_adjusting else self._map.compact()
        if ids_now is not None:
            self._frames.renumber(ids_now)
            self._motion.renumber(ids_now)

    def _result(
        self,
        frame: Frame,
        status: TrackingStatus,
        placement: Placement | None = None,
        is_keyframe: bool = False,
    ) -> StepResult:
        return StepResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=status,
            T_world_camera=None if placement is None else invert(placement.T_camera_world),
            inliers=0 if placement is None else placement.inliers,
            is_keyframe=is_keyframe,
            keyframes=len(self._map.keyframes),
            loop_closures=self._integration.loops.count,
            timings_ms=self._watch.frame_ms,
        )

    def finish(self) -> Reconstruction:
        """Adjust the whole map, make it metric, and return it with the pose of every placed frame.

        Raises:
            TrackingError: it was called before, or no frame could be placed.
        """
        if self._finished:
            raise TrackingError("this tracker has finished already")
        self._workers.between.wait()
        if not self._map.keyframes:
            raise TrackingError("no frame could be placed: too few features, or no depth")
        self._finished = True
        self._watch.next_frame()
        with self, single_threaded():
            self._integration.run_all()
            with self._watch.timed("final"):
                final = optimise_map(self._map, self._integration, self._frames, self._shutter, self.config)
            statistics = RunStatistics(
                frames=self._steps,
                tracked=len(self._frames),
                loop_closures=self._integration.loops.count,
                loops_refused=self._integration.loops.refused,
                relocalisations=self._placed_by[PlacedBy.PLACE],
                registrations=self._placed_by[PlacedBy.REGISTRATION],
                timings_ms=self._watch.mean_ms(),
                timing_calls=self._watch.calls(),
                readout_s=self._shutter.readout_s,
                readout_sigma_s=self._shutter.sigma_s,
                scale_votes=final.scale_votes,
            )
            return build_reconstruction(
                self._map,
                self._integration.mapper,
                self._frames,
                statistics,
                notes=final.notes,
                gravity_w=self._workers.depth.gravity_w(),
                refine_frames=self.config.bundle.final,
            )

    def close(self) -> None:
        """End the tracker's threads; :meth:`finish` does so too."""
        self._finished = True
        self._workers.close()

    def __enter__(self) -> Tracker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _load_libraries() -> None:
    """Import what the first keyframes would import: a second's pause in the middle of tracking."""
    import gtsam  # noqa: F401
    import scipy.linalg
    import scipy.sparse  # noqa: F401
