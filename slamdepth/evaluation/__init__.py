# SPDX-License-Identifier: Apache-2.0
"""Scores: trajectories against a ground truth, depth maps against a sensor."""

from __future__ import annotations

from slamdepth.evaluation.depth import DepthAccumulator, DepthErrors, DepthScore
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
    "DepthAccumulator",
    "DepthErrors",
    "DepthScore",
    "RelativeError",
    "TrajectoryScore",
    "score_trajectory",
]
