# SPDX-License-Identifier: Apache-2.0
"""The figures of a run as one nested dict: the content of ``report.json``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from slamdepth.evaluation import DepthScore, TrajectoryScore
from slamdepth.report.data import ReportData
from slamdepth.report.environment import hardware, versions
from slamdepth.report.shutter import shutter_facts


def build_summary(data: ReportData) -> dict[str, Any]:
    """The figures of a run, as nested plain values. Every key is always there; unknown values are None."""
    run, statistics = data.reconstruction, data.reconstruction.statistics
    return {
        "sequence": data.sequence,
        "health": data.health.to_dict(),
        "depth_model": data.depth_model,
        "depth_is_measured": data.depth_is_measured,
        "features": data.config.features.name if data.config.odometry == "orb" else None,
        "scale": data.scale.to_dict(),
        "frames": statistics.frames,
        "tracked": statistics.tracked,
        "tracked_fraction": statistics.tracked / statistics.frames if statistics.frames else None,
        "skipped_frames": data.skipped_frames,
        "readable_frames": data.readable_frames,
        "promised_frames": data.promised_frames,
        "keyframes": len(run.keyframes),
        "loop_closures": statistics.loop_closures,
        "relocalisations": statistics.relocalisations,
        "registrations": statistics.registrations,
        "fps": data.fps,
        "rolling_shutter": shutter_facts(statistics, data.config.shutter.readout_ms is not None),
        "timings_ms": dict(statistics.timings_ms),
        "timing_calls": dict(statistics.timing_calls),
        "wall_s": statistics.frames / data.fps if data.fps > 0 else None,
        **_trajectory(data.trajectory_score),
        "depth": _depth(data.depth_score),
        "mesh": {
            "vertices": data.mesh.vertices if data.mesh else None,
            "triangles": data.mesh.triangles if data.mesh else None,
        },
        "notes": [*data.notes, *run.notes],
        "weights": [asdict(weights) for weights in data.weights],
        "settings": data.config.for_report(),
        "options": dict(data.options),
        "versions": versions(),
        "hardware": hardware(),
    }


def _trajectory(score: TrajectoryScore | None) -> dict[str, Any]:
    if score is not None:
        return score.to_dict()
    absolute = dict.fromkeys(("rmse_m", "mean_m", "median_m", "max_m"))
    relative = dict.fromkeys(("trans_rmse_m", "rot_rmse_deg", "delta_frames"))
    counts = dict.fromkeys(
        ("matched_poses", "estimate_poses", "ground_truth_poses", "max_difference_s", "path_length_m")
    )
    return {
        "ate": {"se3": absolute, "sim3": {**absolute, "scale": None}, **counts},
        "rpe": {"per_frame": relative, "per_second": dict(relative)},
    }


def _depth(score: DepthScore | None) -> dict[str, Any]:
    if score is not None:
        return score.to_dict()
    names = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3")
    ways = {way: dict.fromkeys(names) for way in ("metric", "sequence_median", "frame_median")}
    rest = ("sequence_scale", "frame_scale_spread", "frames", "pixels", "coverage")
    return {**ways, **dict.fromkeys(rest)}
