# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

from types import TracebackType

import numpy as np

from slamdepth.backend.sights import Sights
from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.depth.metric import metric_model
from slamdepth.errors import TrackingError
from slamdepth.frontend.compiled import load
from slamdepth.frontend.features import Features
from slamdepth.frontend.preparation import Preparation, Prepared
from slamdepth.geometry import invert
from slamdepth.mapping.placement import PlacedBy
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.atlas import Atlas
from slamdepth.tracking.finish import finish_run
from slamdepth.tracking.frame_log import check_frame
from slamdepth.tracking.map_parts import RunParts
from slamdepth.tracking.map_tracker import MapTracker, Placed
from slamdepth.tracking.self_calibration import sights_of
from slamdepth.tracking.workers import DepthWorker, Workers
from slamdepth.types import Camera, Frame, StepResult, TrackingStatus

_WIDE_FEATURES = 3  # times as many where frames are far apart
_MOST_FEATURES = 10000

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
        self._prepare_wide: Preparation | None = None  # made where it is needed first
        self._watch = Stopwatch()
        self._workers = Workers(DepthWorker(model, self._watch, with_uncertainty=config.depth.uncertainty))
        self._atlas = Atlas(self._new_map, config)
        self._steps = 0
        self._last_time_s = -np.inf
        self._finished = False
        _load_libraries()

    def _new_map(self, id_: int) -> MapTracker:
        levels = self._prepare.levels
        run = RunParts(self.camera, self.config, levels, self._workers, self._watch, self._wide_features)
        return MapTracker(id_, run)

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
            placed = self._atlas.track(frame, raw)
            result = self._result(frame, placed)
        self._last_time_s = self._active.motion.last_time_s = frame.timestamp_s
        self._watch.next_frame()
        if self._active.map.keyframes:
            self._active.integration.count_frame()
            if self._active.integration.is_due:
                self._workers.between.begin(self._atlas.run_stage)
        return result

    def _features(self, frame: Frame, prepared: Prepared | None) -> Features:
        prepared = prepared or self._prepare(frame)
        self._watch.add("features", prepared.took_ms)
        self._steps += 1
        return prepared.features

    def _wide_features(self, frame: Frame) -> Features:
        """More features of a frame, for a search over a wide baseline."""
        if self._prepare_wide is None:
            count = min(_WIDE_FEATURES * self.config.features.count, _MOST_FEATURES)
            wide = self.config.features.model_copy(update={"count": count})
            self._prepare_wide = Preparation(self.camera, wide)
        prepared = self._prepare_wide(frame)
        self._watch.add("features", prepared.took_ms)
        return prepared.features

    def _result(self, frame: Frame, placed: Placed | None) -> StepResult:
        maps = self._atlas.maps
        missing = TrackingStatus.LOST if self._active.map.keyframes else TrackingStatus.INITIALISING
        return StepResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=missing if placed is None else _STATUS[placed.placed_by],
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
        self._finished = True
        self._watch.next_frame()
        with self, single_threaded():
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
    return sights_of(tracker._atlas.maps, tracker.camera)


def _load_libraries() -> None:
    """Load what the first keyframes would load: a second's pause in the middle of tracking."""
    import gtsam  # noqa: F401
    import scipy.linalg
    import scipy.sparse  # noqa: F401

    load()
