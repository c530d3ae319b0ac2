# SPDX-License-Identifier: Apache-2.0
"""The rescue: placing a frame by the shape of what it sees when too few features match."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.registration import depth_to_cloud, register_cloud
from slamdepth.geometry import invert, transform
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.types import Camera, DepthPrediction

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_MAP_KEYFRAMES = 4
_COLUMNS = 80  # points across a cloud, whatever the image's size


class CloudRescue:
    """Registers a frame's depth cloud with those of the last keyframes (KISS-ICP)."""

    def __init__(self, camera: Camera, config: Config, landmarks: LandmarkMap) -> None:
        self._camera = camera
        self._config = config
        self._map = landmarks
        self._clouds: dict[int, Floats] = {}

    def place(self, prediction: DepthPrediction, T_camera_world_guess: Floats) -> Floats | None:
        """``T_camera_world (4, 4)`` of a frame from its depth, or None where it cannot be trusted."""
        scale = 1.0 if prediction.is_sensor else self._map.keyframes[-1].scale
        cloud_c = self._cloud(prediction, scale)
        recent = self._map.keyframes[-_MAP_KEYFRAMES:]
        map_w = np.concatenate([self._keyframe_cloud_w(k) for k in recent])
        if len(cloud_c) < 200 or len(map_w) < 200:
            return None
        result = register_cloud(map_w, cloud_c, invert(T_camera_world_guess))
        return invert(result.T_world_camera) if result.is_trusted else None

    def _cloud(self, prediction: DepthPrediction, scale: float) -> Floats:
        depth_m = prediction.values * np.float32(scale)
        return depth_to_cloud(
            depth_m,
            self._camera,
            stride=max(1, round(self._camera.width / _COLUMNS)),
            min_m=self._config.depth.min_m,
            max_m=min(self._config.depth.max_m, 5.0),
            max_jump=0.05,
        )

    def _keyframe_cloud_w(self, keyframe: MapKeyframe) -> Floats:
        if keyframe.id not in self._clouds:
            assert keyframe.prediction is not None
            scale = 1.0 if keyframe.prediction.is_sensor else keyframe.scale
            self._clouds[keyframe.id] = self._cloud(keyframe.prediction, scale)
            for old in [k for k in self._clouds if k <= keyframe.id - 2 * _MAP_KEYFRAMES]:
                del self._clouds[old]
        return transform(keyframe.T_world_camera, self._clouds[keyframe.id])
