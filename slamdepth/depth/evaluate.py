# SPDX-License-Identifier: Apache-2.0
"""Judge a depth model against sensor depth: accuracy, edges, and whether its uncertainty is true."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from slamdepth.depth.base import DepthModel
from slamdepth.errors import DatasetError
from slamdepth.evaluation.depth_judge import DepthJudge, DepthJudgement
from slamdepth.types import DepthPrediction, Frame

Watch = Callable[[Frame, DepthPrediction], None]


def judge_depth(model: DepthModel, frames: Iterable[Frame], *, watch: Watch | None = None) -> DepthJudgement:
    """Predict every frame that has sensor depth and compare.

    A model of any kind can be judged; one whose numbers are no metres has no figures "as
    predicted". Frames are to come in order of time: the intervals suppose neighbours alike.

    Args:
        watch: called with each frame compared and what was predicted for it.

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
