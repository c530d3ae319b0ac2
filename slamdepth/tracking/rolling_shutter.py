# SPDX-License-Identifier: Apache-2.0
"""The readout time of a rolling shutter, given or estimated, and features corrected for it."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from slamdepth.config import ShutterConfig
from slamdepth.frontend.features import Features
from slamdepth.frontend.rolling_shutter import at_middle_row, inverse_depth, px_per_readout_s, row_phase
from slamdepth.io.tree import Tree
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.motion import MotionModel
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

log = logging.getLogger(__name__)

_FIRST_ESTIMATE = 10  # keyframes; estimated again whenever there are half as many more
_MAX_SIGMA_S = 0.004  # a larger deviation says nothing yet
_SIGNIFICANT = 5.0  # deviations from zero; observations are less independent than they claim
_MAX_READOUT_S = 0.05


class RollingShutter:
    """Knows the readout time and moves keypoints to where the middle row's time would put them.

    Attributes:
        readout_s: seconds from the first row of an image to the last; 0 while nothing is known.
        sigma_s: its deviation where it was estimated, else None.
        trusts_motion: False while frames are so far apart that the step between two says nothing of the
            velocity during one; nothing is corrected or estimated then.
    """

    def __init__(self, camera: Camera, config: ShutterConfig, map_: Map) -> None:
        self._raw_camera = camera
        self._camera = camera.without_distortion()
        self._map = map_
        self.trusts_motion = True
        self._may_estimate = config.readout_ms is None
        self.readout_s = 0.0 if config.readout_ms is None else 1e-3 * config.readout_ms
        self.sigma_s: float | None = None
        self._next_estimate = _FIRST_ESTIMATE

    @property
    def is_active(self) -> bool:
        """Whether there is anything to correct."""
        return self.readout_s != 0.0 and self.trusts_motion

    @property
    def is_estimated(self) -> bool:
        """Whether it is to be estimated from the motion."""
        return self._may_estimate and self.trusts_motion

    def correct(self, raw: Features, velocity: Floats, inverse_depth: Floats) -> Features:
        """``raw`` features with their ``px`` at the middle row's time.

        Args:
            raw: as extracted.
            velocity: ``(6,)`` of the camera; see ``velocity_between``.
            inverse_depth: ``(N,)`` of each feature, 1/m of the map.
        """
        phase = row_phase(raw.raw_px, self._raw_camera)
        px = at_middle_row(self._camera, raw.px, phase, inverse_depth, velocity, self.readout_s)
        return replace(raw, px=px)

    def correct_by_motion(self, raw: Features, motion: MotionModel, timestamp_s: float) -> Features:
        """Correct a frame that is not placed yet by the velocity of the frames before it.

        Returns:
            ``raw`` where there is nothing to correct or no motion is known.
        """
        if not self.is_active or not motion.is_known:
            return raw
        T_guess = motion.predict(timestamp_s)
        median = self._median_inverse_depth(T_guess, motion.landmark_ids)
        return self.correct(raw, motion.velocity(timestamp_s, T_guess), np.full(len(raw), median))

    def correct_by_pose(
        self, raw: Features, motion: MotionModel, timestamp_s: float, placement: Placement
    ) -> Features | None:
        """Correct a placed frame by the velocity that leads to its pose.

        Returns:
            None where there is nothing to correct or no motion is known.
        """
        if not self.is_active or not motion.is_known:
            return None
        T = placement.T_camera_world
        inverse = self.inverse_depth(T, placement.landmark_ids)
        return self.correct(raw, motion.velocity(timestamp_s, T), inverse)

    def inverse_depth(self, T_camera_world: Floats, landmark_ids: Ints) -> Floats:
        """``(N,)`` 1/m of features whose landmarks are known; of the others the median.

        Args:
            T_camera_world: ``(4, 4)``.
            landmark_ids: ``(N,)`` of the features, -1 for none.
        """
        out = np.zeros(len(landmark_ids))
        at = np.flatnonzero(landmark_ids >= 0)
        if len(at) == 0:
            return out
        inverse = inverse_depth(T_camera_world, self._map.landmarks.position_w[landmark_ids[at]])
        out[:] = np.median(inverse)
        out[at] = inverse
        return out

    def _median_inverse_depth(self, T_camera_world: Floats, landmark_ids: Ints) -> float:
        """Median 1/m of the landmarks ``(N,)``, -1 for none; 0, which is infinitely far, where all are -1."""
        ids = landmark_ids[landmark_ids >= 0]
        if len(ids) == 0:
            return 0.0
        return float(np.median(inverse_depth(T_camera_world, self._map.landmarks.position_w[ids])))

    def correct_keyframe(self, keyframe: MapKeyframe) -> None:
        """Correct a keyframe's keypoints by its velocity, depth and the readout time as known now."""
        inverse = self.inverse_depth(keyframe.T_camera_world, keyframe.landmark_ids)
        corrected = self.correct(self._raw(keyframe), keyframe.velocity, inverse)
        self._map.set_features(keyframe, corrected)

    def correct_keyframes(self) -> None:
        """Correct all keyframes of the map; does nothing while there is nothing to correct."""
        if self.is_active:
            for keyframe in self._map.keyframes:
                self.correct_keyframe(keyframe)

    def adopt(self, other: RollingShutter) -> None:
        """Take over what is known of the same camera from another map; keyframes follow."""
        if other.sigma_s is None or other.readout_s == self.readout_s:
            return
        self.readout_s, self.sigma_s = other.readout_s, other.sigma_s
        for keyframe in self._map.keyframes:
            self.correct_keyframe(keyframe)

    def state(self) -> Tree:
        """What it has found out, for a checkpoint."""
        return {
            "trusts_motion": self.trusts_motion,
            "readout_s": self.readout_s,
            "sigma_s": self.sigma_s,
            "next_estimate": self._next_estimate,
        }

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave; keyframes stay as they are."""
        self.trusts_motion = state["trusts_motion"]
        self.readout_s, self.sigma_s = state["readout_s"], state["sigma_s"]
        self._next_estimate = state["next_estimate"]

    def go_on_from(self, readout_s: float, sigma_s: float | None, keyframes: int) -> None:
        """Take over what is known of the camera from a saved map with so many keyframes."""
        if self._may_estimate:
            self.readout_s, self.sigma_s = readout_s, sigma_s
        self._next_estimate = max(_FIRST_ESTIMATE, keyframes + _FIRST_ESTIMATE)

    def px_rate(self, keyframe: MapKeyframe, at: Ints) -> Floats:
        """Pixels ``(M, 2)`` by which a second of readout time moves features ``at (M,)`` of a keyframe."""
        inverse = self.inverse_depth(keyframe.T_camera_world, keyframe.landmark_ids)[at]
        features: Features = keyframe.features
        phase = row_phase(features.raw_px[at], self._raw_camera)
        return px_per_readout_s(self._camera, features.px[at], phase, inverse, keyframe.velocity)

    def _raw(self, keyframe: MapKeyframe) -> Features:
        features: Features = keyframe.features
        return replace(features, px=self._raw_camera.undistort_points(features.raw_px))

    def is_due(self, keyframes: int) -> bool:
        """Whether to estimate the readout time now that the map has so many keyframes."""
        if not self.is_estimated or keyframes < self._next_estimate:
            return False
        self._next_estimate = keyframes + keyframes // 2
        return True

    def update(self, change_s: float, sigma_s: float) -> bool:
        """Take over what an adjustment estimated; True where the readout time has changed."""
        found_s = self.readout_s + change_s
        log.info("rolling shutter: %.1f +- %.1f ms from first row to last", 1e3 * found_s, 1e3 * sigma_s)
        if not sigma_s < _MAX_SIGMA_S or abs(found_s) > _MAX_READOUT_S:
            return False
        if abs(found_s) < _SIGNIFICANT * sigma_s:
            found_s = 0.0
        # no camera reads an image for longer than until the next one
        found_s = float(np.clip(found_s, -1.0 / self._raw_camera.fps, 1.0 / self._raw_camera.fps))
        changed = found_s != self.readout_s
        self.readout_s, self.sigma_s = found_s, sigma_s
        return changed
