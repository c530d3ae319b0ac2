# SPDX-License-Identifier: Apache-2.0
"""The camera's readout time, given or found out on the way, and features freed from it."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from slamdepth.config import ShutterConfig
from slamdepth.frontend.features import Features
from slamdepth.frontend.rolling_shutter import at_middle_row, inverse_depth, px_per_readout_s, row_phase
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

log = logging.getLogger(__name__)

_FIRST_SEARCH = 10  # keyframes; sought again whenever there are half as many more
_SURE_S = 0.004  # a deviation beyond says nothing yet
_SIGNIFICANT = 5.0  # deviations from nought; observations are less independent than they claim
_ABSURD_S = 0.05


class Shutter:
    """Knows the readout time and moves keypoints to where the middle row's time would put them.

    Attributes:
        readout_s: seconds from the first row of an image to the last; 0 while nothing is known.
        sigma_s: its deviation where it was found out, else None.
    """

    def __init__(self, camera: Camera, config: ShutterConfig, landmarks: LandmarkMap) -> None:
        self._raw_camera = camera
        self._camera = camera.without_distortion()
        self._map = landmarks
        self.is_sought = config.readout_ms is None
        self.readout_s = 0.0 if config.readout_ms is None else 1e-3 * config.readout_ms
        self.sigma_s: float | None = None
        self._next_search = _FIRST_SEARCH

    @property
    def rolls(self) -> bool:
        """Whether there is anything to correct."""
        return self.readout_s != 0.0

    def correct(self, plain: Features, velocity: Floats, inverse_depth: Floats) -> Features:
        """``plain`` with its ``px`` at the middle row's time.

        Args:
            plain: as extracted.
            velocity: ``(6,)`` of the camera; see ``velocity_between``.
            inverse_depth: ``(N,)`` of each feature, 1/m of the map.
        """
        phase = row_phase(plain.raw_px, self._raw_camera)
        px = at_middle_row(self._camera, plain.px, phase, inverse_depth, velocity, self.readout_s)
        return replace(plain, px=px)

    def inverse_depth(self, T_camera_world: Floats, point_ids: Ints) -> Floats:
        """``(N,)`` 1/m of features whose map points are known; of the others the median."""
        out = np.zeros(len(point_ids))
        at = np.flatnonzero(point_ids >= 0)
        if len(at) == 0:
            return out
        inverse = inverse_depth(T_camera_world, self._map.position_w[point_ids[at]])
        out[:] = np.median(inverse)
        out[at] = inverse
        return out

    def usual_inverse_depth(self, T_camera_world: Floats, point_ids: Ints) -> float:
        """Median 1/m of the features ``point_ids (N,)`` whose map points are known; 0, which is far away,
        where none is."""
        rows = point_ids[point_ids >= 0]
        return (
            float(np.median(inverse_depth(T_camera_world, self._map.position_w[rows]))) if len(rows) else 0.0
        )

    def correct_keyframe(self, keyframe: MapKeyframe) -> None:
        """Move a keyframe's keypoints by what is known now of its velocity, depth and readout time."""
        plain = self._plain(keyframe)
        inverse = self.inverse_depth(keyframe.T_camera_world, keyframe.point_ids)
        keyframe.features = self.correct(plain, keyframe.velocity, inverse)

    def correct_keyframes(self) -> None:
        """The same for all keyframes of the map; nothing where no shutter rolls."""
        if self.rolls:
            for keyframe in self._map.keyframes:
                self.correct_keyframe(keyframe)

    def px_rate(self, keyframe: MapKeyframe, at: Ints) -> Floats:
        """Pixels ``(M, 2)`` a second of readout time moves the features ``at`` of a keyframe."""
        inverse = self.inverse_depth(keyframe.T_camera_world, keyframe.point_ids)[at]
        features: Features = keyframe.features
        phase = row_phase(features.raw_px[at], self._raw_camera)
        return px_per_readout_s(self._camera, features.px[at], phase, inverse, keyframe.velocity)

    def _plain(self, keyframe: MapKeyframe) -> Features:
        features: Features = keyframe.features
        return replace(features, px=self._raw_camera.undistort_points(features.raw_px))

    def is_due(self, keyframes: int) -> bool:
        """Whether to look for the readout time now that the map has so many keyframes."""
        if not self.is_sought or keyframes < self._next_search:
            return False
        self._next_search = keyframes + keyframes // 2
        return True

    def learn(self, change_s: float, sigma_s: float) -> bool:
        """Take over what an adjustment found; True where the readout time is another now."""
        found_s = self.readout_s + change_s
        log.info("rolling shutter: %.1f +- %.1f ms from first row to last", 1e3 * found_s, 1e3 * sigma_s)
        if not sigma_s < _SURE_S or abs(found_s) > _ABSURD_S:
            return False
        if abs(found_s) < _SIGNIFICANT * sigma_s:
            found_s = 0.0
        # no camera reads an image for longer than until the next one
        found_s = float(np.clip(found_s, -1.0 / self._raw_camera.fps, 1.0 / self._raw_camera.fps))
        changed = found_s != self.readout_s
        self.readout_s, self.sigma_s = found_s, sigma_s
        return changed
