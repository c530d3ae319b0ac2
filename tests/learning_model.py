# SPDX-License-Identifier: Apache-2.0
"""A made-up depth model that learns, to test what surrounds one."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from tracking_scene import ConstantDepth

from slamdepth.depth.adaptation import TaughtView
from slamdepth.types import Adaptation, DepthPrediction, Frame


class Learner(ConstantDepth):
    """A wall that is tilted a little more with every lesson; slow, as long as a seed says."""

    def __init__(self, seed: int = 0, most_s: float = 0.0, *, in_use: bool = True) -> None:
        super().__init__()
        self._random, self._most_s = np.random.default_rng(seed), most_s
        self.lessons: list[list[TaughtView]] = []
        self._is_used = in_use

    def adapting(self) -> Learner:
        return self

    def adapt(self, views: Sequence[TaughtView]) -> Adaptation:
        time.sleep(self._random.uniform(0.0, self._most_s))
        self.lessons.append(list(views))
        return Adaptation(len(self.lessons), len(views), 4, 0.02, 0.01, in_use=self._is_used)

    @property
    def tilt(self) -> float:
        return 0.02 * len(self.lessons) if self._is_used else 0.0

    def predict_as_trained(self, frame: Frame) -> DepthPrediction:
        return super().predict(frame)

    def predict(self, frame: Frame) -> DepthPrediction:
        time.sleep(self._random.uniform(0.0, self._most_s))
        flat = super().predict(frame)
        slope = np.exp(self.tilt * np.linspace(-1, 1, len(flat.values)))[:, None].astype(np.float32)
        return replace(flat, values=flat.values * slope)
