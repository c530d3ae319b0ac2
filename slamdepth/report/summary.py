# SPDX-License-Identifier: Apache-2.0
"""The figures of a run as one nested dict: the content of ``report.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from slamdepth.evaluation import DepthScore, surface_figures
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.report.data import ReportData
from slamdepth.report.environment import hardware, versions
from slamdepth.report.maps import first_timestamp_s, map_figures, mesh_figures, trajectory_figures
from slamdepth.report.shutter import shutter_facts


def build_summary(data: ReportData) -> dict[str, Any]:
    """The figures of a run, as nested plain values. Every key is always there; unknown values are None.

    Where the run ended in several maps, figures outside ``maps`` are those of the largest.
    """
    run, statistics = data.reconstruction, data.reconstruction.statistics
    maps = map_figures(data)
    return {
        "sequence": data.sequence,
        "health": data.health.to_dict(),
        "depth_model": data.depth_model,
        "depth_is_measured": data.depth_is_measured,
        "features": data.config.features.name if data.config.odometry == "orb" else None,
        "camera": None if data.camera is None else data.camera.to_dict(),
        "scale": data.scale.to_dict(),
        "frames": statistics.frames,
        "tracked": statistics.tracked,
        "tracked_fraction": statistics.tracked / statistics.frames if statistics.frames else None,
        "tracked_in_all_maps": statistics.tracked + sum(one["frames"] for one in maps[1:]),
        "first_timestamp_s": first_timestamp_s(data),
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
        **trajectory_figures(data.trajectory_score),
        "depth": _depth(data.depth_score),
        "dense": _dense(run.keyframes),
        "mesh": mesh_figures(data.maps[0]),
        "surface": surface_figures(data.surface_scores),
        "maps": maps,
        "maps_joined": statistics.maps_joined,
        "notes": [*data.notes, *run.notes],
        "weights": [asdict(weights) for weights in data.weights],
        "settings": data.config.for_report(),
        "options": dict(data.options),
        "versions": versions(),
        "hardware": hardware(),
    }


def _dense(keyframes: Sequence[Keyframe]) -> dict[str, Any]:
    shares = [keyframe.dense.measured_share for keyframe in keyframes if keyframe.dense is not None]
    return {"keyframes": len(shares), "measured": sum(shares) / len(shares) if shares else None}


def _depth(score: DepthScore | None) -> dict[str, Any]:
    if score is not None:
        return score.to_dict()
    names = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3")
    ways = {way: dict.fromkeys(names) for way in ("metric", "sequence_median", "frame_median")}
    rest = ("sequence_scale", "frame_scale_spread", "frames", "pixels", "coverage")
    return {**ways, **dict.fromkeys(rest)}
