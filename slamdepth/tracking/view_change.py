# SPDX-License-Identifier: Apache-2.0
"""How far the view moves from frame to frame, and so how frames have to be matched."""

from __future__ import annotations

import statistics
from collections import deque

import numpy as np

from slamdepth.geometry import transform
from slamdepth.io.tree import Tree
from slamdepth.mapping.map_view import MapView
from slamdepth.typing import Floats, Ints

_LARGE = 0.1
"""Median change of landmarks in one frame, in radians or as log size: a twelfth of a usual image's width. At
30 Hz it is 170 degrees a second; freiburg1_rpy, shaken by hand, has it in 3 % of its steps."""
_SMALL = 0.05
_SAMPLE = 150  # landmarks that a median is taken of, about
_STEPS = 3  # frames whose median is compared
_TRIED_ALWAYS, _TRIED_EVERY = 4, 4  # lost frames that are searched widely


class ViewChange:
    """Says whether the camera takes large steps.

    Constant velocity then predicts nothing, features change their looks, and what a keyframe does not show
    the next frame does not see. So frames get more features, each becomes a keyframe at once, and the error
    of predicted depths is given a heavy tail, as parallax contradicts them before it was averaged.

    Attributes:
        is_large: whether the last steps were.
    """

    def __init__(self, map_: MapView) -> None:
        self._map = map_
        self._changes: deque[float] = deque(maxlen=_STEPS)
        self._lost = 0
        self.is_large = False

    @property
    def doubts_depth(self) -> bool:
        """Whether steps are large in a map whose depth nothing supports: landmarks are rays then.

        With small steps, depths averaged over many frames keep the scale better than rays do: ``kitti`` at 10
        frames a second lost half of its accuracy (docs/experiments/2026-11-30-prior-where-unbelieved.md).
        """
        return self.is_large and self._map.scale_is_doubted

    def state(self) -> Tree:
        """Everything it remembers, for a checkpoint."""
        return {"changes": list(self._changes), "lost": self._lost, "is_large": self.is_large}

    def restore(self, state: Tree) -> None:
        """Remember what :meth:`state` gave."""
        self._changes = deque(state["changes"], maxlen=_STEPS)
        self._lost, self.is_large = state["lost"], state["is_large"]

    def measure(self, T_before: Floats, T_now: Floats, landmark_ids: Ints) -> None:
        """Take the step between two frames in a row.

        Args:
            T_before, T_now: ``(4, 4)`` camera from world.
            landmark_ids: ``(N,)`` what the later frame sees, -1 for none.
        """
        change = self.change(T_before, T_now, landmark_ids)
        if change is None:
            return
        self._changes.append(change)
        median = statistics.median(self._changes)
        self.is_large = median > (_SMALL if self.is_large else _LARGE)

    def change(self, T_before: Floats, T_now: Floats, landmark_ids: Ints) -> float | None:
        """Median change of landmarks in the image from one pose to another; None without landmarks.

        The change of one is the angle between the rays to it and the change of its size, as a logarithm.
        """
        ids = landmark_ids[landmark_ids >= 0]
        if len(ids) == 0:
            return None
        points_w = self._map.landmarks.position_w[ids[:: 1 + len(ids) // _SAMPLE]]
        a, b = (transform(T, points_w) for T in (T_before, T_now))
        far_a, far_b = (np.sqrt(np.einsum("ni,ni->n", of_one, of_one)) for of_one in (a, b))
        cosine = np.einsum("ni,ni->n", a, b) / (far_a * far_b)
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        changes = np.sort(np.hypot(turn, np.log(far_a / far_b)))
        return float(changes[len(changes) // 2])

    def count_placed(self) -> None:
        """A frame was placed."""
        self._lost = 0

    def count_lost(self) -> bool:
        """A frame was not placed by the usual ways; returns whether a wide search is worth its time now."""
        self._lost += 1
        return self._lost <= _TRIED_ALWAYS or self._lost % _TRIED_EVERY == 0

    def found_wide(self) -> None:
        """Only a wide search placed the frame: the step was large, whatever its angle."""
        self.is_large = True
        self._changes.clear()
        self._changes.append(2.0 * _LARGE)
