# SPDX-License-Identifier: Apache-2.0
"""The motion model: where the camera was last, how it moved there, and so where it should be next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.frontend.rolling_shutter import velocity_between
from slamdepth.geometry import invert, orthonormalised, se3_exp, se3_log
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_keyframe import AnchoredPose, MapKeyframe
from slamdepth.mapping.placement import Placement
from slamdepth.typing import Floats, Ints

_MAX_EXTRAPOLATION = 3.0  # frame intervals the constant velocity is believed for


class MotionModel:
    """Constant velocity from the last placed frame, which is stored relative to a keyframe.

    Attributes:
        last_time_s: of the last frame, placed or not.
        step: ``(4, 4)`` T_camera(now)_camera(before) of the last step.
        landmark_ids: ``(N,)`` what the last placed frame saw, -1 for none.
    """

    def __init__(self) -> None:
        self.last_time_s = -np.inf
        self.step = np.eye(4)
        self.landmark_ids: Ints = np.zeros(0, np.int64)
        self._last: AnchoredPose | None = None
        self._T_camera_world = np.eye(4)
        self._step_s = 0.0

    @property
    def is_known(self) -> bool:
        """False while the camera is lost, and after it was found where no motion led."""
        return self._last is not None

    @property
    def T_camera_world(self) -> Floats:
        """Pose ``(4, 4)`` of the last placed frame; the motion must be known."""
        assert self._last is not None
        return self._T_camera_world

    def follow_map(self) -> None:
        """Evaluate the last pose again, after the map may have moved its keyframe."""
        if self._last is not None:
            # a keyframe's pose comes from a carried one: left alone, rounding would double with each
            self._T_camera_world = orthonormalised(self._last.T_camera_world)
            self._last = AnchoredPose.of(self._T_camera_world, self._last.keyframe)

    def predict(self, timestamp_s: float) -> Floats:
        """``T_camera_world (4, 4)`` at constant velocity; the motion must be known."""
        ratio = (timestamp_s - self.last_time_s) / self._step_s if self._step_s > 0 else 1.0
        ratio = min(ratio, _MAX_EXTRAPOLATION)
        return se3_exp(se3_log(self.step) * ratio) @ self.T_camera_world

    def velocity(self, timestamp_s: float, T_camera_world: Floats) -> Floats:
        """``(6,)`` m/s and rad/s from the last frame to a pose ``(4, 4)`` now; zero while unknown."""
        if self._last is None:
            return np.zeros(6)
        return velocity_between(self.T_camera_world, T_camera_world, timestamp_s - self.last_time_s)

    def advance(self, timestamp_s: float, T_camera_world: Floats) -> None:
        """Take the step from the last frame to a pose ``(4, 4)``, both in the map as it is now."""
        if self._last is not None:
            self.step = T_camera_world @ invert(self.T_camera_world)
            self._step_s = timestamp_s - self.last_time_s
        else:
            self.step = np.eye(4)

    def anchor(self, placement: Placement, keyframe: MapKeyframe) -> None:
        """Store the placed frame that :meth:`advance` led to, relative to ``keyframe``.

        Its pose may differ: a correction of the map for that frame is not taken for motion.
        """
        self._T_camera_world = placement.T_camera_world
        self._last = AnchoredPose.of(placement.T_camera_world, keyframe)
        self.landmark_ids = placement.landmark_ids

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {
            "last_time_s": self.last_time_s,
            "step": self.step,
            "step_s": self._step_s,
            "landmark_ids": self.landmark_ids,
            "last": None if self._last is None else self._last.state(),
            "T_camera_world": self._T_camera_world,
        }

    def restore(self, state: Tree, keyframes: Sequence[MapKeyframe]) -> None:
        """Remember what :meth:`state` gave, in a map of these ``keyframes``."""
        self.last_time_s, self._step_s = state["last_time_s"], state["step_s"]
        self.step, self.landmark_ids = np.array(state["step"]), np.array(state["landmark_ids"])
        last = state["last"]
        self._last = None if last is None else AnchoredPose.restored(last, keyframes)
        self._T_camera_world = np.array(state["T_camera_world"])

    def rescale(self, factor: float) -> None:
        """Follow a map whose metres were multiplied by ``factor``."""
        self.step[:3, 3] *= factor
        self.follow_map()

    def forget(self) -> None:
        """The camera is lost, or the recording was cut: no motion leads from the last frame to the next."""
        self._last = None

    def renumber(self, ids_now: Ints) -> None:
        """Follow new landmark ids, see :meth:`Map.compact`."""
        self.landmark_ids = ids_now[self.landmark_ids]
