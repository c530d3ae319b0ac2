# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from types import TracebackType
from typing import Any

import numpy as np

from slamdepth.backend.sights import Sights
from slamdepth.config import Config
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.metric import metric_model
from slamdepth.errors import DatasetError, TrackingError
from slamdepth.frontend.compiled import load
from slamdepth.frontend.features import Features
from slamdepth.frontend.preparation import Preparation, Prepared
from slamdepth.frontend.repeated_images import has_same_depth, is_repeated
from slamdepth.geometry import invert
from slamdepth.io.tree import Tree
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map, Session
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.atlas import Atlas
from slamdepth.tracking.finish import finish_run
from slamdepth.tracking.frame_log import check_frame
from slamdepth.tracking.keypoint_alignment import align_keypoints
from slamdepth.tracking.map_parts import RunParts, StoredKeyframes
from slamdepth.tracking.map_tracker import MapTracker, Placed
from slamdepth.tracking.saved_maps import MapInfo, load_map, save_map
from slamdepth.tracking.self_calibration import sights_of
from slamdepth.tracking.snapshot import MapSnapshot, snapshot_of
from slamdepth.tracking.status import STATUS
from slamdepth.tracking.wide_features import WideFeatures
from slamdepth.tracking.workers import DepthWorker, Workers
from slamdepth.types import Camera, DepthPrediction, Frame, StepResult, TrackingStatus


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
        start_map: a saved map to go on from: the first frames are looked for in it, and where the camera is
            found the map grows.

    Raises:
        DatasetError: the saved map was made with other features, or with another kind of depth.
        ConfigError: a feature or depth model of that name does not exist.
        WeightsError: the depth model's weights are not there.
    """

    def __init__(
        self,
        camera: Camera,
        depth_model: DepthModel | None = None,
        config: Config | None = None,
        *,
        start_map: Map | None = None,
    ) -> None:
        self.camera = camera
        self.config = config = config or Config()
        model = metric_model(depth_model, config)
        self._prepare = Preparation(camera, config.features)
        self._watch = Stopwatch()
        self._wide_features = WideFeatures(camera, config.features, self._watch)
        self._workers = Workers(DepthWorker(model, self._watch, with_uncertainty=config.depth.uncertainty))
        self._earlier: tuple[Session, ...] = ()
        self._start_images: dict[tuple[int, int], bytes] = {}
        self._atlas = Atlas(self._new_map, config)
        if start_map is not None:
            self._go_on_from(start_map, is_measured=is_sensor(model))
        self._steps = 0
        self._last_time_s = -np.inf
        self._last_seen: tuple[Frame, StepResult] | None = None  # that was tracked last, if it was placed
        self._finished = False
        self._is_complete = False
        self._is_watched = False
        self._snapshot: MapSnapshot | None = None
        _load_libraries()

    def _new_map(self, id_: int) -> MapTracker:
        levels = self._prepare.levels
        run = RunParts(self.camera, self.config, levels, self._workers, self._watch, self._wide_features)
        map_ = MapTracker(id_, run)
        map_.map.session = len(self._earlier)
        return map_

    def _go_on_from(self, saved: Map, *, is_measured: bool) -> None:
        if saved.is_measured != is_measured:
            kinds = ("a network", "a sensor")
            raise DatasetError(
                f"the depth of the map is that of {kinds[saved.is_measured]}, and this run's would be that "
                f"of {kinds[is_measured]}: lengths would contradict each other; choose with --depth"
            )
        load_map(saved, self._active, self.camera, self.config.features)
        self._earlier = saved.sessions
        self._start_images = {
            (keyframe.session, keyframe.frame.index): keyframe.frame.image_bytes()
            for keyframe in self._active.map.keyframes
            if keyframe.frame.is_kept
        }

    @property
    def is_in_start_map(self) -> bool:
        """Whether some frame was placed in the map that the run goes on from."""
        return any(map_.is_loaded and len(map_.frames) > 0 for map_ in self._atlas.maps)

    def is_of_start_map(self, number: int) -> bool:
        """Whether a map of the finished run holds the one that the run goes on from; 0 is the largest."""
        return self._atlas.finished[number].is_loaded

    def saved_map(
        self,
        number: int,
        result: Reconstruction,
        session: Session,
        scale: Mapping[str, Any],
        *,
        factor: float = 1.0,
        with_images: bool = False,
    ) -> Map:
        """A map of the finished run as plain data, to be written to disk.

        Args:
            number: of the map, 0 for the one that :meth:`finish` returned, 1 for the first of its others.
            result: what was made of it.
            session: the recording that was tracked.
            scale: what is known of the scale, as in ``report.json``.
            factor: by which its lengths were multiplied since :meth:`finish`.
            with_images: keep the keyframes' images.
        """
        tracked = self._atlas.finished[number]
        if factor != 1.0:
            tracked.map.rescale(factor)
        earlier = self._earlier if tracked.is_loaded else ()
        if not tracked.is_loaded:
            tracked.map.begin_sessions()
        kept_s = frozenset(result.trajectory.timestamps_s.tolist())
        info = MapInfo(session, scale, with_images)
        return save_map(tracked, self.camera, self.config.features, earlier, kept_s, info)

    @property
    def _active(self) -> MapTracker:
        return self._atlas.active

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
        check_frame(frame, self.camera, self._last_time_s, self._finished)
        with single_threaded():
            raw = self._features(frame, prepared)
            self._workers.between.wait()
            result = self._repeated(frame) or self._track(frame, raw)
            if self._is_watched and self._active.map.keyframes:
                self._snapshot, self._is_watched = snapshot_of(self._active), False
        self._last_time_s = frame.timestamp_s
        self._watch.next_frame()
        if self._active.map.keyframes:
            self._active.integration.count_frame()
            if self._active.integration.is_due:
                self._workers.between.begin(self._atlas.run_stage)
        return result

    def ask_for_snapshot(self) -> None:
        """Let the next :meth:`step` copy the map, for :meth:`take_snapshot`; it changes nothing else."""
        self._is_watched = True

    def take_snapshot(self) -> MapSnapshot | None:
        """The copy that was asked for, once; None where there is none yet."""
        taken, self._snapshot = self._snapshot, None
        return taken

    def _features(self, frame: Frame, prepared: Prepared | None) -> Features:
        prepared = prepared or self._prepare(frame)
        self._watch.add("features", prepared.took_ms)
        self._steps += 1
        return prepared.features

    def _track(self, frame: Frame, raw: Features) -> StepResult:
        placed = self._atlas.track(frame, raw)
        result = self._result(frame, placed)
        self._active.motion.last_time_s = frame.timestamp_s
        self._last_seen = None if placed is None else (frame, result)
        return result

    def _repeated(self, frame: Frame) -> StepResult | None:
        """The result for an image that repeats the one placed last and tells nothing new; None for others."""
        if self._last_seen is None:
            return None
        last, result = self._last_seen
        frames = self._active.frames
        is_last = frames.last_time_s == last.timestamp_s and has_same_depth(frame, last)
        if not (is_last and is_repeated(frame.image_rgb, last.image_rgb)):
            return None
        frames.repeat(frame.timestamp_s)
        return replace(
            self._result(frame, None),
            status=result.status,
            T_world_camera=frames.last_T_world_camera,
            inliers=result.inliers,
            covariance=result.covariance,
            quality=result.quality,
            moving_share=result.moving_share,
        )

    def _result(self, frame: Frame, placed: Placed | None) -> StepResult:
        maps = self._atlas.maps
        missing = TrackingStatus.LOST if self._active.map.keyframes else TrackingStatus.INITIALISING
        return StepResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=missing if placed is None else STATUS[placed.placed_by],
            T_world_camera=None if placed is None else invert(placed.placement.T_camera_world),
            inliers=0 if placed is None else placed.placement.inliers,
            is_keyframe=placed is not None and placed.is_keyframe,
            keyframes=sum(len(map_.map.keyframes) for map_ in maps),
            loop_closures=sum(map_.integration.loops.count for map_ in maps),
            timings_ms=self._watch.frame_ms,
            map_id=self._active.id,
            covariance=None if placed is None else placed.covariance,
            quality=0.0 if placed is None else placed.quality,
            moving_share=None if placed is None else placed.moving_share,
        )

    @property
    def is_quiet(self) -> bool:
        """Whether nothing is under way that :meth:`state` does not hold; waits for work between frames."""
        self._workers.between.wait()
        return not self._finished and self._atlas.is_quiet

    def state(self) -> Tree:
        """Everything the tracker remembers, as arrays and plain values, while :attr:`is_quiet`.

        A tracker of the same camera, model and settings that takes it by :meth:`restore` goes on as this one
        would have. Images and predictions of keyframes are not in it.
        """
        self._workers.between.wait()
        return {
            "atlas": self._atlas.state(),
            "steps": self._steps,
            "last_time_s": self._last_time_s,
            "is_complete": self._is_complete,
            "earlier": [asdict(session) for session in self._earlier],
            "last_seen": None if self._last_seen is None else _seen_state(*self._last_seen),
            "watch": self._watch.state(),
        }

    def restore(
        self,
        state: Tree,
        read_frame: Callable[[int], Frame],
        read_prediction: Callable[[StoredFrame], DepthPrediction],
    ) -> None:
        """Go on from what :meth:`state` gave; nothing was tracked yet.

        Args:
            read_frame: reads a frame that became a keyframe, by its index.
            read_prediction: reads the depth that was predicted for it.
        """
        stored = StoredKeyframes(read_frame, read_prediction, self._start_images)
        self._earlier = tuple(Session(**session) for session in state["earlier"])
        self._atlas.restore(state["atlas"], stored)
        self._steps, self._last_time_s = state["steps"], state["last_time_s"]
        self._is_complete = state["is_complete"]
        if state["last_seen"] is not None:
            last = read_frame(state["last_seen"]["index"])
            self._last_seen = last, _seen_result(last, state["last_seen"])
        self._watch.restore(state["watch"])

    @property
    def keyframes(self) -> list[tuple[StoredFrame, StoredPrediction | None]]:
        """Handles of all keyframes of this run, and of their depth, by map and number."""
        return [
            (keyframe.frame, keyframe.prediction)
            for map_ in self._atlas.maps
            for keyframe in map_.map.keyframes
            if keyframe.session == map_.map.session
        ]

    def complete(self) -> None:
        """Complete what waits after the last frame; :meth:`finish` does so too."""
        self._workers.between.wait()
        if not self._is_complete and self._active.map.keyframes:
            self._is_complete = True
            with single_threaded():
                self._active.integration.run_all()
                self._atlas.meet()

    def finish(self) -> Reconstruction:
        """Adjust each map, make it metric, and return the largest one with the pose of every frame in it.

        Returns:
            The map that most frames were placed in. Those that never met it are its ``others``.

        Raises:
            TrackingError: it was called before, or no frame could be placed.
        """
        if self._finished:
            raise TrackingError("this tracker has finished already")
        self._workers.between.wait()
        if not self._active.map.keyframes:
            raise TrackingError("no frame could be placed: too few features, or no depth")
        if not any(len(map_.frames) for map_ in self._atlas.maps):
            raise TrackingError("no frame could be placed in the map that the run goes on from")
        self._watch.next_frame()
        with self, single_threaded():
            self.complete()
            self._finished = True
            return finish_run(self._atlas, self.config, self._watch, self._steps)

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


def sights_seen(tracker: object) -> Sights | None:
    """What the maps of a tracker see, to find the camera by (:mod:`slamdepth.backend.self_calibration`).

    Args:
        tracker: no frame may follow.

    Returns:
        None where that is too little, or the tracker has no landmarks.
    """
    if not isinstance(tracker, Tracker):
        return None
    if not tracker._finished:
        tracker._workers.between.wait()
        with single_threaded():
            tracker._active.integration.run_all()
            for one in tracker._atlas.maps:
                if tracker.config.bundle.align and not one.is_loaded:
                    align_keypoints(one.map, one.shutter, one.localiser.levels)
    return sights_of(tracker._atlas.maps, tracker.camera)


def _seen_state(frame: Frame, result: StepResult) -> Tree:
    return {
        "index": frame.index,
        "status": result.status.value,
        "inliers": result.inliers,
        "covariance": result.covariance,
        "quality": result.quality,
        "moving_share": result.moving_share,
    }


def _seen_result(frame: Frame, state: Tree) -> StepResult:
    return StepResult(
        frame.index,
        frame.timestamp_s,
        TrackingStatus(state["status"]),
        None,
        state["inliers"],
        covariance=state["covariance"],
        quality=state["quality"],
        moving_share=state["moving_share"],
    )


def _load_libraries() -> None:
    """Load what the first keyframes would load: a second's pause in the middle of tracking."""
    import gtsam  # noqa: F401
    import scipy.linalg
    import scipy.sparse  # noqa: F401

    load()
