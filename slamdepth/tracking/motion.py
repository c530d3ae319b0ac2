# SPDX-License-Identifier: Apache-2.0
"""Where the camera was last and how it moved there: the guess for the next frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.frontend.rolling_shutter import velocity_between
from slamdepth.geometry import invert, se3_exp, se3_log
from slamdepth.tracking.keyframes import Moved
from slamdepth.tracking.localiser import Placement
from slamdepth.typing import Floats, Ints

_MAX_EXTRAPOLATION = 3.0  # frame intervals the constant velocity is believed for


class Motion:
    """The last placement, and the step that led to it.

    Attributes:
        last: None while the camera is lost.
        last_time_s: of the last frame, placed or not.
        step: ``(4, 4)`` T_camera(now)_camera(before) of the last step.
    """

    def __init__(self) -> None:
        self.last: Placement | None = None
        self.last_time_s = -np.inf
        self.step = np.eye(4)
        self._step_s = 0.0

    def guess(self, timestamp_s: float) -> Floats:
        """``T_camera_world (4, 4)`` at constant velocity; the camera must not be lost."""
        assert self.last is not None
        ratio = (timestamp_s - self.last_time_s) / self._step_s if self._step_s > 0 else 1.0
        ratio = min(ratio, _MAX_EXTRAPOLATION)
        return se3_exp(se3_log(self.step) * ratio) @ self.last.T_camera_world

    def velocity(self, timestamp_s: float, T_camera_world: Floats) -> Floats:
        """``(6,)`` m/s and rad/s since the last frame of a camera that is at ``T_camera_world`` now."""
        if self.last is None:
            return np.zeros(6)
        return velocity_between(self.last.T_camera_world, T_camera_world, timestamp_s - self.last_time_s)

    def remember(self, timestamp_s: float, measured: Placement, final: Placement) -> None:
        """Velocity from the pose as measured, so that a correction of the map is not taken for motion."""
        if self.last is not None:
            self.step = measured.T_camera_world @ invert(self.last.T_camera_world)
            self._step_s = timestamp_s - self.last_time_s
        else:
            self.step = np.eye(4)
        self.last = final

    def follow(self, moved: Moved | None) -> None:
        """Move along with the map."""
        if moved is not None and self.last is not None:
            self.last = replace(self.last, T_camera_world=moved.carry(self.last.T_camera_world))

    def renumber(self, row_now: Ints) -> None:
        """Follow new rows of the map's points; see ``LandmarkMap.compact``."""
        if self.last is not None:
            self.last = replace(self.last, point_ids=row_now[self.last.point_ids])
