# SPDX-License-Identifier: Apache-2.0
"""The rescue: placing a frame by the shape of what it sees when too few features match."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.config import Config
from slamdepth.frontend.registration import RegistrationConfig, depth_to_cloud, register_cloud
from slamdepth.geometry import invert, project, transform
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.types import Camera, DepthPrediction
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MAP_KEYFRAMES = 4
_COLUMNS = 80  # points across a cloud, whatever the image's size
# A camera lost for a while has an old guess. Of 1,000 registrations over 0.3 to 3 s of two real sequences,
# with a sensor's and a network's depth, the usual bounds trust 148, 12 of them off by more than 0.1 m or
# 0.1 rad; these trust 91 and err in one, by 0.103 rad.
_OLD_GUESS = RegistrationConfig(min_fitness=0.8, min_observability=0.08)
_MAX_SEEN_THROUGH = 0.1
_NEARER = 0.9  # of the depth measured there: nearer than that, a point would be in the way


class CloudRescue:
    """Registers a frame's depth cloud with those of the last keyframes (KISS-ICP)."""

    def __init__(self, camera: Camera, config: Config, landmarks: LandmarkMap) -> None:
        self._camera = camera
        self._config = config
        self._map = landmarks
        self._clouds: dict[int, Floats] = {}

    def place(
        self, prediction: DepthPrediction, T_camera_world_guess: Floats, *, is_old: bool = False
    ) -> Floats | None:
        """``T_camera_world (4, 4)`` of a frame from its depth, or None where it cannot be trusted.

        Args:
            is_old: the guess is not of the frame before, so the result has to fit better, and
                the frame must not see through what the map holds.
        """
        scale = 1.0 if prediction.is_sensor else self._map.keyframes[-1].scale
        depth_m = prediction.values * np.float32(scale)
        cloud_c = self._cloud(depth_m)
        recent = self._map.keyframes[-_MAP_KEYFRAMES:]
        map_w = np.concatenate([self._keyframe_cloud_w(k) for k in recent])
        if len(cloud_c) < 200 or len(map_w) < 200:
            return None
        config = _OLD_GUESS if is_old else None
        result = register_cloud(map_w, cloud_c, invert(T_camera_world_guess), config)
        T_camera_world = invert(result.T_world_camera)
        if not result.is_trusted or (
            is_old and self._seen_through(depth_m, transform(T_camera_world, map_w)) > _MAX_SEEN_THROUGH
        ):
            return None
        return T_camera_world

    def _seen_through(self, depth_m: NDArray[np.float32], map_c: Floats) -> float:
        """Share of the map's points in view ``(M, 3)`` behind which the frame measured something."""
        px, z = project(self._camera.without_distortion(), map_c)
        limit = np.array([self._camera.width - 1, self._camera.height - 1])
        seen = np.flatnonzero((z > self._config.depth.min_m) & ((px >= 0) & (px <= limit)).all(axis=1))
        column, row = np.rint(px[seen]).astype(np.int64).T
        measured_m = depth_m[row, column]
        known = measured_m > 0
        return float(np.mean(z[seen][known] < _NEARER * measured_m[known])) if known.any() else 1.0

    def _cloud(self, depth_m: NDArray[np.float32]) -> Floats:
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
            self._clouds[keyframe.id] = self._cloud(keyframe.prediction.load().values * np.float32(scale))
            for old in [k for k in self._clouds if k <= keyframe.id - 2 * _MAP_KEYFRAMES]:
                del self._clouds[old]
        return transform(keyframe.T_world_camera, self._clouds[keyframe.id])
