# SPDX-License-Identifier: Apache-2.0
"""Frames placed in a saved map that does not change."""

from __future__ import annotations

from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from slamdepth.config import Config
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import DatasetError, TrackingError
from slamdepth.frontend.compiled import load
from slamdepth.frontend.features import Features
from slamdepth.frontend.preparation import Preparation, Prepared
from slamdepth.geometry import invert
from slamdepth.mapstore import Map
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.frame_adjustment import adjust_frames
from slamdepth.tracking.frame_alignment import FrameAligner
from slamdepth.tracking.frame_log import check_frame
from slamdepth.tracking.map_parts import RunParts
from slamdepth.tracking.map_tracker import MapTracker, Placed
from slamdepth.tracking.saved_maps import load_map, with_features_of
from slamdepth.tracking.status import STATUS
from slamdepth.tracking.wide_features import WideFeatures
from slamdepth.tracking.workers import DepthWorker, Workers
from slamdepth.types import Camera, Frame, StepResult, TrackingStatus, Trajectory


class MapLocaliser:
    """Places frames in a saved map, as :class:`Tracker` does in its own, and changes nothing in it.

    A pose is given where the view fits one place of the map only, and by more landmarks than chance. No depth
    is predicted: a frame costs some 20 ms. Where the map has images, keypoints are aligned in them, which
    costs about 10 ms more.

    Example:
        >>> map = slamdepth.Map.load("runs/kitchen")  # doctest: +SKIP
        >>> with MapLocaliser(map, camera) as localiser:  # doctest: +SKIP
        ...     for frame in frames:
        ...         result = localiser.step(frame)  # result.T_world_camera in the map, or None
        ...         sure = result.quality
        ...     trajectory = localiser.finish()  # all poses, adjusted together

    Args:
        map: see :meth:`slamdepth.Map.load`.
        camera: of the frames; None takes the map's.
        config: settings; None takes the defaults. Features are those of the map.

    Raises:
        DatasetError: the map was made with features that are not known here, or with other words.
    """

    def __init__(self, map: Map, camera: Camera | None = None, config: Config | None = None) -> None:
        self.camera = camera or map.camera
        self.config = config = with_features_of(map, config)
        if len(map) == 0:
            raise DatasetError("the map has no keyframes")
        self._prepare = Preparation(self.camera, config.features)
        self._watch = Stopwatch()
        self._workers = Workers(DepthWorker(SensorDepth(), self._watch))
        run = RunParts(
            self.camera,
            config,
            self._prepare.levels,
            self._workers,
            self._watch,
            WideFeatures(self.camera, config.features, self._watch),
            grows_maps=False,
        )
        self._map = MapTracker(0, run)
        load_map(map, self._map, self.camera, config.features)
        self._aligner: FrameAligner | None = None
        if any(keyframe.frame.is_kept for keyframe in self._map.map.keyframes):
            self._aligner = self._map.aligner = FrameAligner(self._map.map, self._prepare.levels)
        self._last_time_s = -np.inf
        self._closed = False
        load()

    @property
    def has_images(self) -> bool:
        """Whether the map has images of this camera, in which keypoints are aligned."""
        return self._aligner is not None

    @property
    def damaged_images(self) -> int:
        """Images of the map that did not decode when they were asked for, and were left out."""
        return 0 if self._aligner is None else len(self._aligner.damaged)

    def prepare(self, frame: Frame) -> Prepared:
        """The features of a frame, which another thread may find ahead of :meth:`step`."""
        return self._prepare(frame)

    def step(self, frame: Frame, prepared: Prepared | None = None) -> StepResult:
        """Place the next frame of a recording.

        Args:
            frame: later than all before; taken by ``self.camera``.
            prepared: what :meth:`prepare` gave for it; None prepares it here.

        Returns:
            Its pose in the map. None where it was not found, and where the frames that follow have to
            confirm it first: once they do, :meth:`trajectory` has it.

        Raises:
            TrackingError: the localiser was closed, or time does not increase.
            CameraError: the frame was taken by another camera.
        """
        check_frame(frame, self.camera, self._last_time_s, self._closed)
        with single_threaded():
            placed = self._map.track(frame, self._features(frame, prepared))
        self._last_time_s = self._map.motion.last_time_s = frame.timestamp_s
        return self._result(frame, None if self._map.check.is_provisional else placed)

    def place(self, frame: Frame) -> StepResult:
        """Place a single image, whatever was placed before; the next :meth:`step` starts anew.

        Returns:
            As :meth:`step`. The pose is None also where only a motion could confirm it.

        Raises:
            TrackingError: the localiser was closed.
            CameraError: the image was taken by another camera.
        """
        check_frame(frame, self.camera, -np.inf, self._closed)
        with single_threaded():
            placed = self._map.place_alone(frame, self._features(frame, None))
        return self._result(frame, placed)

    def finish(self) -> Trajectory:
        """Adjust all placed frames and the landmarks they see together, and end.

        Frames that follow one another correct one another so, and what later frames saw corrects earlier
        ones. The map does not change.

        Returns:
            As :meth:`trajectory`, which gives the adjusted poses from now on.
        """
        if not self._closed and self.config.bundle.final:
            with single_threaded():
                adjust_frames(
                    self._map.frames, self._map.map, self.camera, self.config, self._map.shutter.readout_s
                )
        self.close()
        return self.trajectory()

    def trajectory(self) -> Trajectory:
        """The frames given to :meth:`step` that were placed and not withdrawn, in the map's world."""
        return self._map.frames.trajectory()

    def quality(self) -> NDArray[np.float64]:
        """Of the frames of :meth:`trajectory`, ``(N,)``, see :class:`slamdepth.StepResult`."""
        return self._map.frames.quality

    def _features(self, frame: Frame, prepared: Prepared | None) -> Features:
        prepared = prepared or self._prepare(frame)
        self._watch.next_frame()
        self._watch.add("features", prepared.took_ms)
        return prepared.features

    def _result(self, frame: Frame, placed: Placed | None) -> StepResult:
        keyframes = len(self._map.map.keyframes)
        if placed is None:
            return StepResult(
                frame.index,
                frame.timestamp_s,
                TrackingStatus.LOST,
                None,
                keyframes=keyframes,
                timings_ms=self._watch.frame_ms,
            )
        return StepResult(
            frame.index,
            frame.timestamp_s,
            STATUS[placed.placed_by],
            invert(placed.placement.T_camera_world),
            inliers=placed.placement.inliers,
            keyframes=keyframes,
            timings_ms=self._watch.frame_ms,
            covariance=placed.covariance,
            quality=placed.quality,
            moving_share=placed.moving_share,
        )

    def close(self) -> None:
        """End the localiser's threads."""
        self._closed = True
        self._workers.close()

    def __enter__(self) -> MapLocaliser:
        if self._closed:
            raise TrackingError("this localiser was closed; make a new one")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
