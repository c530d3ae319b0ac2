# SPDX-License-Identifier: Apache-2.0
"""The tracker: frames in, poses out; no file is read or written here."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.depth.base import DepthModel
from slamdepth.errors import TrackingError
from slamdepth.frontend.features import Features, create_extractor
from slamdepth.geometry import invert, so3_exp, so3_log
from slamdepth.mapping.landmarks import LandmarkMap
from slamdepth.tracker.local_mapper import LocalMapper
from slamdepth.tracker.localiser import Localiser, Placement
from slamdepth.types import Camera, Frame, StepResult, TrackingStatus

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Placed:
    """An ordinary frame, kept relative to a keyframe so that it moves with it."""

    index: int
    timestamp_s: float
    keyframe: int
    T_camera_keyframe: NDArray[np.float64]


class Tracker:
    def __init__(self, camera: Camera, depth_model: DepthModel, config: Config | None = None) -> None:
        self.camera = camera
        self.config = config or Config()
        self._depth_model = depth_model
        self._extractor = create_extractor(self.config.features)
        self.map = LandmarkMap()
        self._localiser = Localiser(camera, self.config, self.map)
        self._mapper = LocalMapper(camera, self.config, self.map, self._localiser)
        self.placed: list[_Placed] = []
        self._last: Placement | None = None
        self._velocity = np.eye(4)
        self._last_time_s = 0.0
        self._last_dt_s = 0.0
        self._reference_overlap = 0
        self._totals: dict[str, list[float]] = defaultdict(list)
        self._timings: dict[str, float] = {}
        self.frames = 0

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        ms = (time.perf_counter() - start) * 1e3
        self._timings[stage] = self._timings.get(stage, 0.0) + ms
        self._totals[stage].append(ms)

    def step(self, frame: Frame) -> StepResult:
        import cv2

        self._timings = {}
        if self.frames and frame.timestamp_s <= self._last_time_s:
            raise TrackingError("timestamps must increase")
        self.frames += 1
        with self._timed("features"):
            gray = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
            features = self._extractor.extract(gray, self.camera)
        is_keyframe = False
        status = TrackingStatus.TRACKING
        if not self.map.keyframes:
            placement = Placement(np.eye(4), np.full(len(features), -1), np.eye(6))
            is_keyframe = True
        else:
            with self._timed("tracking"):
                placement = self._track(frame, features)
            if placement is None:
                self._last_time_s = frame.timestamp_s
                self._last = None
                return StepResult(frame.index, frame.timestamp_s, TrackingStatus.LOST, None, timings_ms=self._timings)
            is_keyframe = self._wants_keyframe(placement)
        if is_keyframe:
            placement = self._make_keyframe(frame, features, placement)
        self._remember(frame, placement, is_keyframe)
        return StepResult(
            frame.index,
            frame.timestamp_s,
            status,
            invert(placement.T_camera_world),
            placement.inliers,
            is_keyframe,
            len(self.map.keyframes),
            0,
            self._timings,
        )

    def _track(self, frame: Frame, features: Features) -> Placement | None:
        dt = frame.timestamp_s - self._last_time_s
        if self._last is not None:
            ratio = dt / self._last_dt_s if self._last_dt_s > 0 else 1.0
            T_guess = _scaled_motion(self._velocity, min(ratio, 3.0)) @ self._last.T_camera_world
            rows = self.map.resolve(self._last.point_ids)
            rows = np.unique(rows[rows >= 0])
            placement = self._localiser.track(features, T_guess, rows)
            if placement is not None:
                return placement
        for k in (len(self.map.keyframes) - 1,):
            placement = self._localiser.from_keyframe(features, k)
            if placement is not None:
                return placement
        for k in range(len(self.map.keyframes) - 2, -1, -1):
            placement = self._localiser.from_keyframe(features, k, minimum=30)
            if placement is not None:
                return placement
        return None

    def _wants_keyframe(self, placement: Placement) -> bool:
        reference = self.map.keyframes[-1]
        seen = np.zeros(self.map.size + 1, dtype=bool)
        seen[placement.point_ids] = True
        seen[-1] = False
        still = int(np.count_nonzero(seen[reference.point_ids]))
        self._reference_overlap = max(self._reference_overlap, still)
        config = self.config.tracking
        return still < config.keyframe_overlap * self._reference_overlap or (
            placement.inliers < config.keyframe_min_inliers and still < 0.9 * self._reference_overlap
        )

    def _make_keyframe(self, frame: Frame, features: Features, placement: Placement) -> Placement:
        with self._timed("depth"):
            prediction = self._depth_model.predict(frame)
        with self._timed("mapping"):
            keyframe = self._mapper.insert(
                frame, features, placement.T_camera_world, placement.point_ids, prediction
            )
            if keyframe.id:
                self._mapper.search_neighbours(keyframe)
        if keyframe.id:
            with self._timed("bundle"):
                self._mapper.adjust_window(keyframe)
            self._mapper.cull(keyframe)
        self._reference_overlap = 0
        return Placement(keyframe.T_camera_world.copy(), keyframe.point_ids.copy(), placement.information)

    def _remember(self, frame: Frame, placement: Placement, is_keyframe: bool) -> None:
        if self._last is not None:
            self._velocity = placement.T_camera_world @ invert(self._last_T)
            self._last_dt_s = frame.timestamp_s - self._last_time_s
        else:
            self._velocity = np.eye(4)
        self._last, self._last_time_s = placement, frame.timestamp_s
        self._last_T = placement.T_camera_world
        k = self.map.keyframes[-1]
        self.placed.append(
            _Placed(frame.index, frame.timestamp_s, k.id, placement.T_camera_world @ k.T_world_camera)
        )


def _scaled_motion(T: Floats, ratio: float) -> Floats:
    out = np.eye(4)
    out[:3, :3] = so3_exp(so3_log(T[:3, :3]) * ratio)
    out[:3, 3] = T[:3, 3] * ratio
    return out
