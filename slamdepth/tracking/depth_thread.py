# SPDX-License-Identifier: Apache-2.0
"""Depth predicted in a thread of its own, one frame after the other."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slamdepth.depth.base import DepthModel
from slamdepth.tracking.threads import one_thread_here
from slamdepth.tracking.world_gravity import WorldGravity
from slamdepth.types import DepthPrediction, Frame


class DepthThread:
    """Runs a depth model beside the tracker.

    The thread computes on one core: the tracker needs the other, and sums do not depend on
    how many there are. A sensor's depth is there already and is passed on at once.

    Args:
        with_uncertainty: False keeps back what a network says of its errors.
    """

    def __init__(self, model: DepthModel, *, with_uncertainty: bool = True) -> None:
        self._model = model
        self._with_uncertainty = with_uncertainty
        self._gravity = WorldGravity()
        self._pool = ThreadPoolExecutor(1, "slamdepth-depth", initializer=one_thread_here)
        self._asked: list[tuple[Frame, Future[DepthPrediction]]] = []
        self._taken: tuple[Frame, DepthPrediction] | None = None

    def has_depth(self, frame: Frame) -> bool:
        """A sensor may have no depth for a frame; a network always has."""
        return self._model.name != "sensor" or frame.depth_m is not None

    def is_instant(self, frame: Frame) -> bool:
        """Whether the depth of ``frame`` costs no wait: a sensor's, or one taken before."""
        return self._model.name == "sensor" or self._is_taken(frame)

    def _is_taken(self, frame: Frame) -> bool:
        return self._taken is not None and self._taken[0] is frame

    def ask(self, frame: Frame, R_world_camera: NDArray[np.float64] | None = None) -> None:
        """Start the prediction for ``frame``, after those asked for before; nothing where it was.

        Args:
            R_world_camera: ``(3, 3)``, where it is known: what one frame tells of gravity helps the next.
        """
        if not self._is_taken(frame) and all(asked is not frame for asked, _ in self._asked):
            self._asked.append((frame, self._pool.submit(self._predict, frame, R_world_camera)))

    def _predict(self, frame: Frame, R_world_camera: NDArray[np.float64] | None) -> DepthPrediction:
        if R_world_camera is None or frame.gravity is not None:
            prediction = self._model.predict(frame)
        else:
            known = self._gravity.in_camera(R_world_camera)
            prediction = self._model.predict(replace(frame, gravity=known))
            if known is None and prediction.gravity is not None:
                self._gravity.add(R_world_camera, prediction.gravity, prediction.gravity_share)
        if self._with_uncertainty or prediction.is_sensor:
            return prediction
        return replace(prediction, sigma_log=None)

    def take(self, frame: Frame) -> DepthPrediction:
        """The prediction for ``frame``; waits for it. The last one taken can be taken again."""
        if self._taken is None or self._taken[0] is not frame:
            self.ask(frame)
            n = next(n for n, (asked, _) in enumerate(self._asked) if asked is frame)
            self._taken = (frame, self._asked[n][1].result())
            del self._asked[n]
        return self._taken[1]

    def down_w(self) -> NDArray[np.float64] | None:
        """Unit direction of gravity ``(3,)`` in the world, by all frames asked for so far; waits for them.
        None where they do not tell it."""
        return self._pool.submit(self._gravity.in_world).result()

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=True)
