# SPDX-License-Identifier: Apache-2.0
"""When the map teaches the depth model, and with which of its points."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.adaptation import TaughtView
from slamdepth.mapping.landmarks import LandmarkMap, MapKeyframe
from slamdepth.tracker.depth_thread import DepthThread
from slamdepth.tracker.local_mapper import LocalMapper
from slamdepth.types import Adaptation, Reconstruction

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

log = logging.getLogger(__name__)

_EVERY = 4  # keyframes
_FIRST = 8
_MIN_OBSERVATIONS = 3
_MAX_SIGMA_LOG = 0.05
_MAX_POINTS = 200  # a view
_HELD_OUT_OF = 5  # one point of so many, in all views that see it, is judged by and never learnt from


class MapTeaching:
    """Teaches the model in ``depth`` every few keyframes. Counts decide, never a clock: the tracker's
    result does not depend on how long learning takes.

    Args:
        depth: runs a model of :func:`slamdepth.depth.adaptation.adapting`.
    """

    def __init__(self, landmarks: LandmarkMap, mapper: LocalMapper, depth: DepthThread) -> None:
        self._map = landmarks
        self._mapper = mapper
        self._depth = depth
        self._taught: list[tuple[int, Future[Adaptation]]] = []  # keyframes there were, what it says

    def keyframe_joined(self, count: int) -> None:
        """Tell that ``count`` keyframes have their depth and are adjusted."""
        if count >= _FIRST and count % _EVERY == 0:
            self._taught.append((count, self._depth.adapt(self._views(count))))

    def set_back(self) -> None:
        """Give all keyframes the predictions of the model as trained, once the last has joined.

        The map's scale is taken from them, which what was learnt from the map must not move, and so is
        the final dense depth: tied to the map's points it has what they teach already, and what the
        lessons say elsewhere made it worse (docs/depth.md).
        """
        first = next((count for count, taught in self._taught if taught.result().in_use), None)
        if first is not None:
            for keyframe in self._map.keyframes[first:]:
                self._mapper.predict_anew(keyframe, self._depth.again(keyframe.frame, as_trained=True))

    def finish(self) -> Adaptation:
        """Learn from the finished map."""
        learnt = self._depth.adapt(self._views(len(self._map.keyframes))).result()
        log.debug("learning from the map: %s", [*(taught.result() for _, taught in self._taught), learnt])
        return learnt

    def predict_anew(self, made: Reconstruction) -> Reconstruction:
        """``made`` with all keyframes' predictions, but not their final depth, by what was learnt."""
        if made.adaptation is None or not made.adaptation.in_use:
            return made
        keyframes = [replace(k, prediction=self._depth.again(k.frame)) for k in made.keyframes]
        return replace(made, keyframes=tuple(keyframes))

    def _views(self, count: int) -> list[TaughtView]:
        return [self._view(keyframe) for keyframe in self._map.keyframes[:count]]

    def _view(self, keyframe: MapKeyframe) -> TaughtView:
        at, rows, z = self._map.depths_seen(keyframe, _MIN_OBSERVATIONS)
        chosen = np.flatnonzero(self._map.sigma_along_ray(rows, keyframe.center_w) < _MAX_SIGMA_LOG)
        chosen = chosen[:: max(1, len(chosen) // _MAX_POINTS)]
        return TaughtView(
            keyframe.frame,
            keyframe.features.raw_px[at[chosen]],
            np.log(z[chosen]),
            rows[chosen] % _HELD_OUT_OF == 0,
        )


def in_words(learnt: Adaptation) -> str:
    """One line for a reader of the report."""
    text = f"--adapt: the depth model learnt {learnt.updates} times, from {learnt.views} keyframes"
    if learnt.loss_before is None or learnt.loss_after is None:
        return f"{text}; too few to judge by, so its predictions are as trained"
    text += (
        f"; loss on points held out, in {learnt.judged_views} keyframes new to it: "
        f"{learnt.loss_before:.4f} as trained, {learnt.loss_after:.4f} with what it had learnt"
    )
    if not learnt.in_use:
        return f"{text}; so it is not used"
    return f"{text}; predictions were made anew, but dense depth is from those as trained"
