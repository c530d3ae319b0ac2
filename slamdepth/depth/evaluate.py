# SPDX-License-Identifier: Apache-2.0
"""Evaluate a depth model against sensor depth: accuracy, edges and calibration of its uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from slamdepth.depth.base import DepthModel
from slamdepth.errors import DatasetError
from slamdepth.evaluation.depth_judge import DepthJudge, DepthJudgement
from slamdepth.types import DepthPrediction, Frame

Watch = Callable[[Frame, DepthPrediction], None]


def judge_depth(model: DepthModel, frames: Iterable[Frame], *, watch: Watch | None = None) -> DepthJudgement:
    """Predict every frame that has sensor depth, and compare.

    Args:
        model: of any kind; one that is not metric has no figures "as predicted".
        frames: in order of time, because the confidence intervals take neighbouring frames as correlated.
        watch: called with each frame that is compared, and its prediction.

    Raises:
        DatasetError: no frame has depth.
    """
    judge = DepthJudge(model.kind)
    for frame in frames:
        if frame.depth_m is None:
            continue
        prediction = model.predict(frame)
        if judge.add(prediction, frame.depth_m) and watch is not None:
            watch(frame, prediction)
    judgement = judge.judge()
    if judgement is None:
        raise DatasetError("no frame has sensor depth to judge a prediction by")
    return judgement
