# SPDX-License-Identifier: Apache-2.0
"""Ordinary frames as views."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from slamdepth.dense.rectify import Rectifier
from slamdepth.dense.sweep import View
from slamdepth.frontend.rolling_shutter import velocity_between
from slamdepth.geometry import invert
from slamdepth.types import Trajectory
from slamdepth.typing import Bytes, Floats, Floats32

_CONSECUTIVE_S = 0.2  # frames farther apart tell no velocity


class FrameViews:
    """Rectified images of the frames of a trajectory, named by their rows in it.

    Args:
        trajectory: of all frames.
        read: gives the ``(H, W, 3)`` uint8 image of a row, or None where there is none.
        inverse_depth: 1/m, of the scene in general.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        read: Callable[[int], Bytes | None],
        rectifier: Rectifier,
        inverse_depth: float,
    ) -> None:
        self._trajectory, self._read, self._rectifier = trajectory, read, rectifier
        self._inverse_depth = inverse_depth
        self._views: dict[int, View | None] = {}

    def positions(self, row: int) -> Floats32 | None:
        """Where the rectified pixels of a frame come from, see :meth:`Rectifier.positions`."""
        return self._rectifier.positions(velocity_at(self._trajectory, row), self._inverse_depth)

    def load(self, rows: Iterable[int]) -> None:
        """Read what is asked for and not there yet, in order, and forget all others."""
        wanted = sorted(set(rows))
        self._views = {row: self._views[row] for row in wanted if row in self._views}
        for row in wanted:
            if row not in self._views:
                self._views[row] = self._made(row)

    def get(self, row: int) -> View | None:
        """The view of a frame that was loaded; None where it has no image."""
        return self._views[row]

    def _made(self, row: int) -> View | None:
        image_rgb = self._read(row)
        if image_rgb is None:
            return None
        grey = self._rectifier.grey(image_rgb, self.positions(row))
        return View(grey, self._trajectory.T_world_camera[row])


def velocity_at(trajectory: Trajectory, row: int) -> Floats | None:
    """Velocity ``(6,)`` of the camera at a pose, from the frames before and after; None where unknown.

    See :func:`slamdepth.frontend.rolling_shutter.velocity_between`.
    """
    times_s, poses = trajectory.timestamps_s, trajectory.T_world_camera
    before, after = max(0, row - 1), min(len(times_s) - 1, row + 1)
    interval_s = float(times_s[after] - times_s[before])
    if not 0 < interval_s <= 2 * _CONSECUTIVE_S:
        return None
    return velocity_between(invert(poses[before]), invert(poses[after]), interval_s)
