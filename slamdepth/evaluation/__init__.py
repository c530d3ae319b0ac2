# SPDX-License-Identifier: Apache-2.0
"""Scores: trajectories and surfaces against the truth, depth maps against a sensor, runs without either."""

from __future__ import annotations

from slamdepth.evaluation.bootstrap import Interval
from slamdepth.evaluation.depth import DepthErrors, DepthScore, DepthScorer
from slamdepth.evaluation.depth_judge import DepthJudge, DepthJudgement, mean_over_sets
from slamdepth.evaluation.health import Health, MapHealth, judge_run
from slamdepth.evaluation.health_facts import MapFacts, RunFacts
from slamdepth.evaluation.health_numbers import HealthNumbers
from slamdepth.evaluation.health_rules import Verdict
from slamdepth.evaluation.health_spans import HealthSpan, SpanKind
from slamdepth.evaluation.surface import (
    AlignedScores,
    Surface,
    SurfaceScore,
    score_surface,
    surface_figures,
    vertex_errors_m,
)
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
    "AlignedScores",
    "DepthErrors",
    "DepthJudge",
    "DepthJudgement",
    "DepthScore",
    "DepthScorer",
    "Health",
    "HealthNumbers",
    "HealthSpan",
    "Interval",
    "MapFacts",
    "MapHealth",
    "RelativeError",
    "RunFacts",
    "SpanKind",
    "Surface",
    "SurfaceScore",
    "TrajectoryScore",
    "Verdict",
    "judge_run",
    "mean_over_sets",
    "score_surface",
    "score_trajectory",
    "surface_figures",
    "vertex_errors_m",
]
