# SPDX-License-Identifier: Apache-2.0
"""``--odometry kiss-icp``: poses from the shape of every frame's depth alone."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.metric import metric_model
from slamdepth.errors import TrackingError
from slamdepth.frontend.registration import CloudOdometry, CloudOdometryConfig, depth_to_cloud
from slamdepth.geometry import invert, project, transform
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import KeyframeStore, StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking.frame_log import check_frame
from slamdepth.types import (
    Camera,
    Frame,
    RunStatistics,
    StepResult,
    TrackingStatus,
    Trajectory,
)
from slamdepth.typing import Floats

_COLUMNS = 160  # points across a cloud, whatever the image's size


@dataclass
class _Kept:
    frame: StoredFrame
    prediction: StoredPrediction
    T_world_camera: Floats

    def final(self, id: int) -> Keyframe:
        no_features = np.zeros((0, 2))
        return Keyframe(id, self.frame, self.T_world_camera, no_features, 1.0, self.prediction, as_given)


class CloudTracker:
    """The interface of ``Tracker`` over KISS-ICP: pure odometry, neither features nor loops.

    Every frame's depth is needed, so a network runs on every frame. The scale is the
    depth's own.

    Args:
        camera, depth_model, config: as for ``Tracker``.
    """

    def __init__(
        self, camera: Camera, depth_model: DepthModel | None = None, config: Config | None = None
    ) -> None:
        self.camera = camera
        self.config = config or Config()
        self._depth_model = metric_model(depth_model, self.config)
        reach = CloudOdometryConfig(
            min_m=max(self.config.depth.min_m, 0.2), max_m=min(self.config.depth.max_m, 5.0)
        )
        self._range_m = (reach.min_m, reach.max_m)
        self._odometry = CloudOdometry(reach)
        self._times: list[float] = []
        self._poses: list[Floats] = []
        self._keyframes: list[_Kept] = []
        self._store = KeyframeStore(self.config.map.keyframe_memory_mib)
        self._frames = 0
        self._last_time_s = -np.inf
        self._finished = False
        self._totals: dict[str, list[float]] = defaultdict(list)

    def prepare(self, frame: Frame) -> None:
        """Nothing can be found out ahead: see ``Tracker.prepare``."""

    def step(self, frame: Frame, prepared: None = None) -> StepResult:
        """Place the next frame; arguments, result and errors as for ``Tracker.step``."""
        check_frame(frame, self.camera, self._last_time_s, self._finished)
        self._last_time_s = frame.timestamp_s
        self._frames += 1
        timings: dict[str, float] = {}
        if is_sensor(self._depth_model) and frame.depth_m is None:
            return self._result(frame, None, 0, False, timings)
        start = time.perf_counter()
        prediction = self._depth_model.predict(frame)
        timings["depth"] = (time.perf_counter() - start) * 1e3
        start = time.perf_counter()
        with single_threaded():
            cloud = depth_to_cloud(
                prediction.values,
                self.camera,
                stride=max(1, round(self.camera.width / _COLUMNS)),
                min_m=self._range_m[0],
                max_m=self._range_m[1],
            )
            T_world_camera = self._odometry.register(cloud, frame.timestamp_s)
        timings["tracking"] = (time.perf_counter() - start) * 1e3
        for stage, ms in timings.items():
            self._totals[stage].append(ms)
        if T_world_camera is None:
            return self._result(frame, None, 0, False, timings)
        self._times.append(frame.timestamp_s)
        self._poses.append(T_world_camera)
        is_keyframe = self._overlap(cloud, T_world_camera) < self.config.tracking.keyframe_overlap
        if is_keyframe:
            self._keyframes.append(_Kept(StoredFrame(frame), StoredPrediction(prediction), T_world_camera))
            self._store.tidy(self._keyframes)
        return self._result(frame, T_world_camera, len(cloud), is_keyframe, timings)

    def _overlap(self, cloud_c: Floats, T_world_camera: Floats) -> float:
        """Share of the cloud that the last keyframe has in its view."""
        if not self._keyframes:
            return 0.0
        T_keyframe_camera = invert(self._keyframes[-1].T_world_camera) @ T_world_camera
        px, z = project(self.camera.without_distortion(), transform(T_keyframe_camera, cloud_c))
        inside = (z > 0) & (px >= 0).all(axis=1)
        inside &= (px[:, 0] < self.camera.width) & (px[:, 1] < self.camera.height)
        return float(np.mean(inside))

    def _result(
        self,
        frame: Frame,
        T_world_camera: Floats | None,
        inliers: int,
        is_keyframe: bool,
        timings_ms: dict[str, float],
    ) -> StepResult:
        if T_world_camera is not None:
            status = TrackingStatus.TRACKING
        else:
            status = TrackingStatus.LOST if self._poses else TrackingStatus.INITIALISING
        return StepResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=status,
            T_world_camera=T_world_camera,
            inliers=inliers,
            is_keyframe=is_keyframe,
            keyframes=len(self._keyframes),
            timings_ms=timings_ms,
        )

    def close(self) -> None:
        """End the odometry; there are no threads to be ended."""
        self._finished = True

    def __enter__(self) -> CloudTracker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def finish(self) -> Reconstruction:
        """Hand over the trajectory; errors as for ``Tracker.finish``."""
        if self._finished:
            raise TrackingError("this tracker has finished already")
        if not self._poses:
            raise TrackingError("no frame could be placed: no depth in range")
        self._finished = True
        return Reconstruction(
            trajectory=Trajectory(np.array(self._times), np.stack(self._poses)),
            keyframes=tuple(kept.final(i) for i, kept in enumerate(self._keyframes)),
            points_m=self._odometry.local_map_w,
            statistics=RunStatistics(
                frames=self._frames,
                tracked=len(self._poses),
                timings_ms={stage: float(np.mean(values)) for stage, values in self._totals.items()},
                timing_calls={stage: len(values) for stage, values in self._totals.items()},
            ),
        )
