# SPDX-License-Identifier: Apache-2.0
"""Scores: trajectories against a ground truth, depth maps against a sensor."""

from __future__ import annotations

from slamdepth.evaluation.bootstrap import Interval
from slamdepth.evaluation.depth import DepthErrors, DepthScore, DepthScorer
from slamdepth.evaluation.depth_judge import DepthJudge, DepthJudgement, mean_over_sets
from slamdepth.evaluation.trajectory import (
    MAX_DIFFERENCE_S,
    AbsoluteError,
    RelativeError,
    TrajectoryScore,
    score_trajectory,
)

__all__ = [
    "MAX_DIFFERENCE_S",
    "AbsoluteError",
    "DepthErrors",
    "DepthJudge",
    "DepthJudgement",
    "DepthScore",
    "DepthScorer",
    "Interval",
    "RelativeError",
    "TrajectoryScore",
    "mean_over_sets",
    "score_trajectory",
]
