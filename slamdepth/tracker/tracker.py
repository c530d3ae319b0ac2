# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.errors import TrackingError
from slamdepth.frontend.features import Features, create_extractor
from slamdepth.geometry import invert, rotation_angle_rad, so3_exp, so3_log
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracker.checks import check_frame, model_for
from slamdepth.tracker.finish import build_reconstruction, optimise_everything
from slamdepth.tracker.frame_log import FrameLog
from slamdepth.tracker.local_mapper import LocalMapper
from slamdepth.tracker.localiser import Localiser, Placement
from slamdepth.tracker.loop_closer import LoopCloser
from slamdepth.tracker.rescue import CloudRescue
from slamdepth.tracker.threads import one_blas_thread
from slamdepth.types import (
    Camera,
    DepthPrediction,
    Frame,
    Reconstruction,
    StepResult,
    TrackingStatus,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

log = logging.getLogger(__name__)

_MAX_EXTRAPOLATION = 3.0  # frame intervals the constant velocity is believed for
_RELOCALISATION_CANDIDATES = 4
_START_KEYFRAMES = 5  # until so many, most points are known by a predicted depth only
_RESCUE_STEP_M, _RESCUE_TURN_RAD = 0.1, 0.15  # between keyframes without features


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
        self._depth_model = model_for(depth_model, self.config)
        self._extractor = create_extractor(self.config.features)
        self._map = LandmarkMap()
        self._localiser = Localiser(camera, self.config, self._map)
        self._mapper = LocalMapper(camera, self.config, self._map, self._localiser)
        self._loops = LoopCloser(self.config, self._map, self._localiser)
        self._rescue = CloudRescue(camera, self.config, self._map)
        self._log = FrameLog(camera, self._map)
        self._last: Placement | None = None
        self._velocity = np.eye(4)  # T_camera(now)_camera(before)
        self._last_time_s = -np.inf
        self._last_step_s = 0.0
        self._reference_overlap = 0
        self._frames = 0
        self._relocalisations = 0
        self._rescues = 0
        self._finished = False
        self._predicted_depth: tuple[Frame, DepthPrediction] | None = None
        self._timings: dict[str, float] = {}
        self._totals: dict[str, list[float]] = defaultdict(list)

    def step(self, frame: Frame) -> StepResult:
        """Place the next frame.

        Args:
            frame: later than all before; taken by ``self.camera``.

        Returns:
            Its pose and what was done; ``T_world_camera`` is None where it was lost.

        Raises:
            TrackingError: the tracker has finished, or time does not increase.
            CameraError: the frame was taken by another camera.
        """
        check_frame(frame, self.camera, self._last_time_s, self._finished)
        self._timings = {}
        with one_blas_thread():
            result = self._step(frame)
        self._last_time_s = frame.timestamp_s
        return result

    def _step(self, frame: Frame) -> StepResult:
        import cv2

        self._frames += 1
        with self._timed("features"):
            gray = np.asarray(cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            features = self._extractor.extract(gray, self.camera)
        if not self._map.keyframes:
            return self._start(frame, features)
        with self._timed("tracking"):
            placement, status = self._place(frame, features)
        if placement is None:
            self._last = None
            return self._result(frame, TrackingStatus.LOST, None, False)
        is_keyframe = self._wants_keyframe(placement) and self._can_be_keyframe(frame)
        if is_keyframe:
            before = placement
            placement = self._make_keyframe(frame, features, placement)
            self._remember_motion(frame, before, placement)
        else:
            self._remember_motion(frame, placement, placement)
        self._log.add(frame.timestamp_s, features, placement, is_keyframe)
        return self._result(frame, status, placement, is_keyframe)

    def _start(self, frame: Frame, features: Features) -> StepResult:
        need = self.config.tracking.min_inliers
        if len(features) < need or not self._can_be_keyframe(frame):
            return self._result(frame, TrackingStatus.INITIALISING, None, False)
        if self._mapper.count_births(features, self._predict_depth(frame)) < need:
            return self._result(frame, TrackingStatus.INITIALISING, None, False)
        empty = Placement(np.eye(4), np.full(len(features), -1, dtype=np.int64))
        placement = self._make_keyframe(frame, features, empty)
        self._remember_motion(frame, placement, placement)
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
            timings_ms=self._timings,
        )

    def _place(self, frame: Frame, features: Features) -> tuple[Placement | None, TrackingStatus]:
        if self._last is not None:
            T_guess = self._predicted(frame, self._last)
            rows = self._map.resolve(self._last.point_ids)
            placement = self._localiser.track(features, T_guess, np.unique(rows[rows >= 0]))
            if placement is not None:
                return placement, TrackingStatus.TRACKING
            placement = self._localiser.from_keyframe(features, len(self._map.keyframes) - 1)
            if placement is not None:
                return placement, TrackingStatus.TRACKING
            placement = self._register(frame, features, T_guess)
            if placement is not None:
                self._rescues += 1
                return placement, TrackingStatus.RESCUED
        placement = self._relocalise(features)
        if placement is not None:
            self._relocalisations += 1
            return placement, TrackingStatus.RELOCALISED
        return None, TrackingStatus.LOST

    def _predicted(self, frame: Frame, last: Placement) -> Floats:
        """``T_camera_world`` at constant velocity."""
        ratio = (frame.timestamp_s - self._last_time_s) / self._last_step_s if self._last_step_s > 0 else 1.0
        ratio = min(ratio, _MAX_EXTRAPOLATION)
        motion = np.eye(4)
        motion[:3, :3] = so3_exp(so3_log(self._velocity[:3, :3]) * ratio)
        motion[:3, 3] = self._velocity[:3, 3] * ratio
        return motion @ last.T_camera_world

    def _relocalise(self, features: Features) -> Placement | None:
        answers = self._loops.places.query(features.descriptors, top_k=_RELOCALISATION_CANDIDATES)
        newest = len(self._map.keyframes) - 1
        tried = newest if self._last is not None else -1
        for k in dict.fromkeys([newest, *(k for k, _ in answers)]):
            if k == tried:
                continue
            placement = self._localiser.from_keyframe(
                features, k, minimum=self.config.loops.min_inliers if k != newest else None
            )
            if placement is not None:
                return placement
        return None

    def _register(self, frame: Frame, features: Features, T_guess: Floats) -> Placement | None:
        if not self._can_be_keyframe(frame):
            return None
        T = self._rescue.place(self._predict_depth(frame), T_guess)
        if T is None:
            return None
        log.info("frame %d: too few features match; placed by registration of its depth", frame.index)
        empty = Placement(T, np.full(len(features), -1, dtype=np.int64))
        recent = self._map.points_of(
            [k.id for k in self._map.keyframes[-self.config.tracking.local_keyframes :]]
        )
        return self._localiser.attach(features, empty, recent)

    def _can_be_keyframe(self, frame: Frame) -> bool:
        """A sensor may have no depth for a frame; a network always has."""
        return self._depth_model.name != "sensor" or frame.depth_m is not None

    def _predict_depth(self, frame: Frame) -> DepthPrediction:
        if self._predicted_depth is None or self._predicted_depth[0] is not frame:
            with self._timed("depth"):
                self._predicted_depth = (frame, self._depth_model.predict(frame))
        return self._predicted_depth[1]

    def _wants_keyframe(self, placement: Placement) -> bool:
        """The view has moved on when much of what the last keyframe saw is seen no more."""
        reference = self._map.keyframes[-1]
        seen = np.zeros(self._map.size + 1, dtype=bool)
        seen[placement.point_ids] = True
        seen[-1] = False
        still = int(np.count_nonzero(seen[reference.point_ids]))
        self._reference_overlap = max(self._reference_overlap, still)
        tracking = self.config.tracking
        if placement.inliers < tracking.min_inliers:
            # rescued: worth a keyframe where there are features to go on with, or new surfaces
            many = len(placement.point_ids) >= tracking.keyframe_min_inliers
            return many or self._has_moved_on(placement, reference)
        if self._reference_overlap < tracking.min_inliers:
            return True  # the last keyframe saw too little to measure by
        starting = len(self._map.keyframes) < _START_KEYFRAMES
        enough = tracking.keyframe_overlap_start if starting else tracking.keyframe_overlap
        if still < enough * self._reference_overlap:
            return True
        return placement.inliers < tracking.keyframe_min_inliers and still < 0.9 * self._reference_overlap

    def _has_moved_on(self, placement: Placement, reference: MapKeyframe) -> bool:
        D = placement.T_camera_world @ reference.T_world_camera
        turned = float(rotation_angle_rad(D[:3, :3]))
        return float(np.linalg.norm(D[:3, 3])) > _RESCUE_STEP_M or turned > _RESCUE_TURN_RAD

    def _make_keyframe(self, frame: Frame, features: Features, placement: Placement) -> Placement:
        prediction = self._predict_depth(frame)
        with self._timed("mapping"):
            keyframe = self._mapper.insert(
                frame, features, placement.T_camera_world, placement.point_ids, prediction
            )
            self._mapper.search_neighbours(keyframe)
        with self._timed("bundle"):
            self._mapper.adjust_window(keyframe)
        with self._timed("loops"):
            self._loops.add(keyframe)
            correction = self._loops.close(keyframe)
        if correction is not None:
            self._log.rescale(correction.scales)
            with self._timed("bundle"):
                self._mapper.search_neighbours(keyframe)
                self._mapper.adjust_window(keyframe)
        with self._timed("mapping"):
            self._mapper.cull(keyframe)
        self._reference_overlap = 0
        return Placement(keyframe.T_camera_world.copy(), keyframe.point_ids.copy())

    def _remember_motion(self, frame: Frame, measured: Placement, final: Placement) -> None:
        """Velocity from the pose as measured, so that a correction of the map is not taken for motion."""
        if self._last is not None:
            self._velocity = measured.T_camera_world @ invert(self._last.T_camera_world)
            self._last_step_s = frame.timestamp_s - self._last_time_s
        else:
            self._velocity = np.eye(4)
        self._last = final

    def finish(self) -> Reconstruction:
        """Adjust the whole map, make it metric, place every frame in it, and hand it over.

        Raises:
            TrackingError: it was called before, or no frame could be placed.
        """
        if self._finished:
            raise TrackingError("this tracker has finished already")
        if not self._map.keyframes:
            raise TrackingError("no frame could be placed: too few features, or no depth")
        self._finished = True
        self._timings = {}
        with one_blas_thread(), self._timed("final"):
            notes, votes = optimise_everything(self._map, self._mapper, self._log, self.config)
        mean = {stage: float(np.mean(values)) for stage, values in self._totals.items()}
        return build_reconstruction(
            self._map,
            self._mapper,
            self._log,
            frames_total=self._frames,
            loop_closures=self._loops.count,
            relocalisations=self._relocalisations,
            rescues=self._rescues,
            timings_ms=mean,
            notes=notes,
            scale_votes=votes,
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            ms = (time.perf_counter() - start) * 1e3
            self._timings[stage] = self._timings.get(stage, 0.0) + ms
            self._totals[stage].append(ms)
