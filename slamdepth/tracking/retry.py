# SPDX-License-Identifier: Apache-2.0
"""When a lost camera's depth is registered again, and from which guess.

Frames are counted, never milliseconds: the same sequence is tried at the same frames on
every machine. A network's depth costs several frames' time, a sensor's hardly any.
"""

from __future__ import annotations

import numpy as np

from slamdepth.geometry import se3_exp, se3_log
from slamdepth.typing import Floats

_FRAMES = 120  # four seconds at 30 Hz: after that the camera may be anywhere
_EVERY, _EVERY_PREDICTED = 3, 6
_DECAY = 0.5  # of the velocity with every frame: nobody knows how the motion went on


class Retry:
    """Counts the frames since the camera was lost."""

    def __init__(self) -> None:
        self._T_camera_world: Floats | None = None
        self._motion = np.zeros(6)
        self._lost = 0
        self._tried = 0  # the lost frame tried last

    def start(self, T_camera_world: Floats, velocity: Floats) -> None:
        """The camera was last at ``T_camera_world`` with ``velocity``, both ``(4, 4)``, a frame ago."""
        self._T_camera_world = T_camera_world
        self._motion = se3_log(velocity)
        self._lost, self._tried = 1, 1

    def count_frame(self) -> None:
        """Tell that another frame has come."""
        self._lost += 1

    def is_due(self, *, has_depth: bool, is_instant: bool) -> bool:
        """Whether this lost frame is to be tried.

        Args:
            has_depth: there is a depth to register.
            is_instant: it costs nothing, as a sensor's.
        """
        if not has_depth or self._T_camera_world is None or self._lost > _FRAMES:
            return False
        every = _EVERY if is_instant else _EVERY_PREDICTED
        if self._lost < self._tried + every:
            return False
        self._tried = self._lost
        return True

    def guess(self) -> Floats:
        """``T_camera_world (4, 4)`` now, had the motion died away since."""
        assert self._T_camera_world is not None
        reach = sum(_DECAY**n for n in range(self._lost))
        return se3_exp(self._motion * reach) @ self._T_camera_world
