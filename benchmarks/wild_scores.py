# SPDX-License-Identifier: Apache-2.0
"""Figures of one finished run on a recording: what was placed, how well, what leaps, what is called good."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.evaluation import score_trajectory
from slamdepth.evaluation.health_spans import GOOD_SPAN_S
from slamdepth.evaluation.leaps import repeated_poses
from slamdepth.io import read_tum_trajectory
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

LEAP = 15.0
"""Steps faster than so many times the median speed are leaps."""

GOOD_SHARE, GOOD_M = 0.02, 0.05
"""A result is truly good where its error is below this share of the path, or below so many metres."""


def read_maps(folder: Path) -> list[Trajectory]:
    """The trajectory of each map of a run folder, the largest first."""
    others = sorted(folder.glob("maps/*/trajectory.txt"), key=lambda file: int(file.parent.name))
    files = [folder / "trajectory.txt", *others]
    return [read_tum_trajectory(file)[0] for file in files if file.is_file()]


def count_leaps(trajectory: Trajectory) -> int:
    """Steps whose speed is over ``LEAP`` times the median one; repeated images are left out."""
    if len(trajectory) < 3:
        return 0
    kept = ~repeated_poses(_speeds(trajectory), np.diff(trajectory.timestamps_s))
    speeds = _speeds(Trajectory(trajectory.timestamps_s[kept], trajectory.T_world_camera[kept]))
    return int(np.count_nonzero(speeds > LEAP * max(float(np.median(speeds)), 1e-12)))


def _speeds(trajectory: Trajectory) -> Floats:
    """``(N - 1,)`` of the camera's centre, a second."""
    steps = np.linalg.norm(np.diff(trajectory.T_world_camera[:, :3, 3], axis=0), axis=1)
    return np.asarray(steps / np.diff(trajectory.timestamps_s))


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


def score_map(truths: Sequence[Trajectory], estimate: Trajectory, *, is_metric: bool) -> dict[str, Any]:
    """The errors of one map: its pieces of true poses, those that could be scored, and the worst of them.

    ``is_good`` is None where none could be scored.
    """
    pieces = [score_piece(truth, estimate, is_metric=is_metric) for truth in truths]
    scored = [piece for piece in pieces if "error" not in piece]
    worst = max(scored, key=lambda piece: float(piece["sim3"]), default={})
    return {
        "pieces": pieces,
        "worst": worst,
        "is_good": all(piece["is_good"] for piece in scored) if scored else None,
    }


def score_spans(
    summary: dict[str, Any], maps: Sequence[Trajectory], truths: Sequence[Trajectory], *, is_metric: bool
) -> list[dict[str, Any]]:
    """The stretches that a run calls good, and whether they are.

    ``is_good`` is None where less than five seconds of a stretch have true poses, or the camera stood still.
    """
    found = []
    judged = summary.get("health", {}).get("maps", [])
    for number, (health, estimate) in enumerate(zip(judged, maps, strict=False), start=1):
        times_s = estimate.timestamps_s - summary["first_timestamp_s"]
        for from_s, to_s in health["good_spans_s"]:
            kept = (times_s >= from_s) & (times_s <= to_s)
            part = Trajectory(estimate.timestamps_s[kept], estimate.T_world_camera[kept])
            long = [truth for truth in truths if _overlap_s(truth, part) >= GOOD_SPAN_S]
            score = score_map(long, part, is_metric=is_metric)
            about = {"map": number, "from_s": from_s, "to_s": to_s, "is_good": score["is_good"]}
            found.append({**about, "sim3": score["worst"].get("sim3"), "path": score["worst"].get("path")})
    return found


def _overlap_s(a: Trajectory, b: Trajectory) -> float:
    """Seconds for which both have poses."""
    if not len(a) or not len(b):
        return 0.0
    ends = min(a.timestamps_s[-1], b.timestamps_s[-1]), max(a.timestamps_s[0], b.timestamps_s[0])
    return float(ends[0] - ends[1])


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
    scores = [score_map(truths, one, is_metric=is_metric) for one in maps]
    worst, pieces = scores[0]["worst"], scores[0]["pieces"]
    verdicts = [one["verdict"] for one in summary.get("maps", [])]
    return {
        "frames": frames,
        "posed": len(set().union(*(one.timestamps_s.tolist() for one in maps))) / frames,
        "largest": len(maps[0]) / frames,
        "maps": len(maps),
        **{name: worst.get(name) for name in ("sim3", "sim3_percent", "se3_m", "scale")},
        "is_good": scores[0]["is_good"],
        "pieces": pieces if len(pieces) > 1 else [],
        "unscored": [piece["error"] for piece in pieces if "error" in piece],
        "loops": summary.get("loop_closures"),
        "joined": summary.get("maps_joined"),
        "leaps": sum(map(count_leaps, maps)),
        "each_map": [
            {
                "frames": len(one),
                "sim3": score["worst"].get("sim3"),
                "sim3_percent": score["worst"].get("sim3_percent"),
                "is_good": score["is_good"],
                "verdict": said,
            }
            for one, score, said in zip(maps, scores, verdicts, strict=False)
        ],
        "spans": score_spans(summary, maps, truths, is_metric=is_metric),
        "verdict": verdict(summary),
        "health": summary.get("health"),
    }
