# SPDX-License-Identifier: Apache-2.0
"""Judge a depth model against sensor depth: accuracy, and whether its uncertainty is true."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from slamdepth.depth.base import DepthModel
from slamdepth.errors import DatasetError
from slamdepth.evaluation.depth import DepthAccumulator, DepthScore
from slamdepth.types import DepthKind, Frame

_GRID = 4


@dataclass(frozen=True)
class UncertaintyScore:
    """How far ``sigma_log`` can be believed; means over frames.

    Attributes:
        surest_half: AbsRel of each frame's surest half of pixels over that of all of
            them, after a median per frame. 1 = says nothing.
        within_one_sigma: share of pixels, over all frames, whose log error as predicted
            is below sigma; 0.68 where sigma is calibrated.
    """

    surest_half: float
    within_one_sigma: float


@dataclass(frozen=True)
class DepthJudgement:
    """Accuracy and, where the model says how sure it is, the worth of that."""

    accuracy: DepthScore
    uncertainty: UncertaintyScore | None

    def to_dict(self) -> dict[str, Any]:
        """The figures as nested plain numbers."""
        return asdict(self)


def judge_depth(model: DepthModel, frames: Iterable[Frame]) -> DepthJudgement:
    """Predict every frame that has sensor depth and compare.

    Raises:
        DatasetError: no frame has depth, or the model's values are no metric depth.
    """
    if model.kind is not DepthKind.METRIC:
        raise DatasetError(f"'{model.name}' predicts {model.kind.value}, which has no metres to judge")
    accumulator = DepthAccumulator()
    surest, below, pixels = [], 0, 0
    for frame in frames:
        if frame.depth_m is None:
            continue
        prediction = model.predict(frame)
        if not accumulator.add(prediction.values, frame.depth_m) or prediction.sigma_log is None:
            continue
        predicted, sensor, sigma = (
            a[::_GRID, ::_GRID].ravel() for a in (prediction.values, frame.depth_m, prediction.sigma_log)
        )
        both = (predicted > 0) & (sensor > 0)
        if both.sum() < 2:
            continue
        error = np.log(predicted[both].astype(np.float64) / sensor[both])
        sigma = sigma[both]
        scaled = np.abs(np.expm1(error - np.median(error)))
        sure = sigma <= np.median(sigma)
        surest.append(float(scaled[sure].mean() / max(float(scaled.mean()), 1e-9)))
        below += int((np.abs(error) < sigma).sum())
        pixels += len(error)
    score = accumulator.score()
    if score is None:
        raise DatasetError("no frame has sensor depth to judge a prediction by")
    uncertainty = UncertaintyScore(float(np.mean(surest)), below / pixels) if surest else None
    return DepthJudgement(score, uncertainty)
