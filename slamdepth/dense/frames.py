# SPDX-License-Identifier: Apache-2.0
"""Ordinary frames as views."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.dense.rectify import Rectifier
from slamdepth.dense.sweep import View
from slamdepth.errors import ImageDecodeError
from slamdepth.frontend.rolling_shutter import velocity_between
from slamdepth.geometry import invert
from slamdepth.typing import Bytes, Floats

log = logging.getLogger(__name__)

_CONSECUTIVE_S = 0.2  # frames farther apart tell no velocity


@dataclass(frozen=True)
class SourceFrame:
    """A frame with a pose.

    Attributes:
        index: of its image.
        timestamp_s: seconds.
        T_world_camera: ``(4, 4)``.
    """

    index: int
    timestamp_s: float
    T_world_camera: Floats


class FrameViews:
    """Rectified images of frames.

    Args:
        frames: in order of time.
        read: gives the ``(H, W, 3)`` uint8 image of an index.
        inverse_depth: 1/m, of the scene in general.
    """

    def __init__(
        self,
        frames: Sequence[SourceFrame],
        read: Callable[[int], Bytes],
        rectifier: Rectifier,
        inverse_depth: float,
    ) -> None:
        self._frames, self._read, self._rectifier = frames, read, rectifier
        self.inverse_depth = inverse_depth
        self._row = {frame.index: row for row, frame in enumerate(frames)}
        self._views: dict[int, View | None] = {}

    def velocity(self, index: int) -> Floats | None:
        """Velocity ``(6,)`` of the camera at a frame, from those before and after it; None where unknown."""
        row = self._row[index]
        before, after = self._frames[max(0, row - 1)], self._frames[min(len(self._frames) - 1, row + 1)]
        interval_s = after.timestamp_s - before.timestamp_s
        if not 0 < interval_s <= 2 * _CONSECUTIVE_S:
            return None
        return velocity_between(invert(before.T_world_camera), invert(after.T_world_camera), interval_s)

    def load(self, indices: Iterable[int]) -> None:
        """Read what is asked for and not there yet, in order, and forget all others."""
        wanted = sorted(set(indices))
        self._views = {index: self._views[index] for index in wanted if index in self._views}
        for index in wanted:
            if index not in self._views:
                self._views[index] = self._made(index)

    def get(self, index: int) -> View | None:
        """The view of a frame that was loaded; None where its image does not decode."""
        return self._views[index]

    def _made(self, index: int) -> View | None:
        try:
            image_rgb = self._read(index)
        except ImageDecodeError as error:
            log.debug("frame %d is no view: %s", index, error)
            return None
        positions = self._rectifier.positions(self.velocity(index), self.inverse_depth)
        grey = self._rectifier.grey(image_rgb, positions)
        return View(np.ascontiguousarray(grey), self._frames[self._row[index]].T_world_camera)
