# SPDX-License-Identifier: Apache-2.0
"""Figures of one finished run on a recording: what was placed, how well, and what leaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.evaluation import score_trajectory
from slamdepth.io import read_tum_trajectory
from slamdepth.types import Trajectory

LEAP = 15.0
"""Steps faster than so many times the median speed are leaps."""

GOOD_SHARE, GOOD_M = 0.02, 0.05
"""A result is truly good where its error is below this share of the path, or below so many metres."""


def read_maps(folder: Path) -> list[Trajectory]:
    """The trajectory of each map of a run folder, the largest first."""
    files = [folder / "trajectory.txt", *sorted(folder.glob("maps/*/trajectory.txt"))]
    return [read_tum_trajectory(file)[0] for file in files if file.is_file()]


def count_leaps(trajectory: Trajectory) -> int:
    """Steps whose speed is over ``LEAP`` times the median one."""
    if len(trajectory) < 3:
        return 0
    steps = np.linalg.norm(np.diff(trajectory.T_world_camera[:, :3, 3], axis=0), axis=1)
    speeds = steps / np.diff(trajectory.timestamps_s)
    return int(np.count_nonzero(speeds > LEAP * max(float(np.median(speeds)), 1e-12)))


def score_piece(truth: Trajectory, estimate: Trajectory, *, is_metric: bool) -> dict[str, Any]:
    """Errors of one piece of true poses, in its units; ``{"error": why}`` where it cannot be scored."""
    try:
        score = score_trajectory(truth, estimate)
    except DatasetError as error:
        return {"error": str(error)}
    extent = float(np.linalg.norm(np.ptp(score.truth_m, axis=0)))
    sim3, limit = score.sim3.rmse_m, GOOD_SHARE * score.path_length_m
    return {
        "matched": score.matched,
        "of": len(truth),
        "sim3": sim3,
        "extent": extent,
        "path": score.path_length_m,
        "sim3_percent": 100.0 * sim3 / extent if extent > 0 else None,
        "se3_m": score.se3.rmse_m if is_metric else None,
        "scale": score.sim3.scale if is_metric else None,
        "is_good": sim3 < (max(limit, GOOD_M) if is_metric else limit),
    }


def verdict(summary: dict[str, Any]) -> str:
    """What ``report.json`` says about itself under ``health``; "-" where it says nothing."""
    health = summary.get("health")
    if isinstance(health, dict):
        health = health.get("verdict") or health.get("status")
    return "-" if health is None else str(health)


def figures(
    folder: Path, summary: dict[str, Any], frames: int, truths: Sequence[Trajectory], *, is_metric: bool
) -> dict[str, Any]:
    """The row of one run.

    Args:
        folder: its run folder.
        summary: the content of its ``report.json``.
        frames: that it was given.
        truths: pieces of true poses; the worst one that can be scored counts.
        is_metric: whether they are in metres.
    """
    maps = read_maps(folder)
    pieces = [score_piece(truth, maps[0], is_metric=is_metric) for truth in truths]
    scored = [piece for piece in pieces if "error" not in piece]
    worst = max(scored, key=lambda piece: float(piece["sim3"]), default={})
    return {
        "frames": frames,
        "posed": len(set().union(*(one.timestamps_s.tolist() for one in maps))) / frames,
        "largest": len(maps[0]) / frames,
        "maps": len(maps),
        **{name: worst.get(name) for name in ("sim3", "sim3_percent", "se3_m", "scale")},
        "is_good": all(piece["is_good"] for piece in scored) if scored else None,
        "pieces": pieces if len(pieces) > 1 else [],
        "unscored": [piece["error"] for piece in pieces if "error" in piece],
        "loops": summary.get("loop_closures"),
        "leaps": sum(map(count_leaps, maps)),
        "verdict": verdict(summary),
        "health": summary.get("health"),
    }
