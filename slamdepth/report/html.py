# SPDX-License-Identifier: Apache-2.0
"""One self-contained page that shows and explains a run."""

from __future__ import annotations

from typing import Any

from slamdepth.report import plots
from slamdepth.report.axes import about_views
from slamdepth.report.console import ALIGNMENTS
from slamdepth.report.data import ReportData
from slamdepth.report.keyframe_images import NEAR_TO_FAR, UNKNOWN, jpeg_address, keyframe_gallery
from slamdepth.report.maps import MAP_HEADS, about_maps, map_rows, maps_plot
from slamdepth.report.page import render
from slamdepth.report.scale import scale_interval, scale_rows
from slamdepth.report.scene.page import scene_content
from slamdepth.report.speed import speed_caption, speed_plot, stage_times
from slamdepth.report.text import MISSING, count, fixed, percent

_DEPTH_FIGURES = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3")


def build_html(data: ReportData, summary: dict[str, Any]) -> str:
    """The page of a run as one text: nothing loaded from elsewhere, no scripts but those of the 3D view.

    Args:
        data: what the run made, for plots and images.
        summary: its figures, of :func:`slamdepth.report.build_summary`.
    """
    run = data.reconstruction
    return render(
        "run.html.j2",
        summary=summary,
        charts=_charts(data, summary),
        notes=_notes(summary),
        span_rows=_span_rows(summary["health"]),
        map_heads=MAP_HEADS,
        map_rows=map_rows(summary["maps"]),
        about_maps=about_maps(len(summary["maps"]), summary["maps_joined"]),
        axes=about_views(run.gravity_w),
        absolute_rows=_absolute_rows(summary["ate"]),
        relative_rows=_relative_rows(summary["rpe"]),
        depth_rows=_depth_rows(summary["depth"]),
        gallery=keyframe_gallery(run.keyframes),
        near_to_far=NEAR_TO_FAR,
        unknown=UNKNOWN,
        map_points=len(run.points_m),
        surface_rows=_surface_rows(summary["surface"]),
        mesh_images=[
            {"title": one.title, "caption": one.caption, "address": jpeg_address(one.image_rgb)}
            for one in data.mesh_images
        ],
        speed_caption=speed_caption(summary["wall_s"]),
        weight_rows=[[w["name"], w["trained_on"], w["licence"], w["sha256"]] for w in summary["weights"]],
        scale_rows=scale_rows(data.scale),
        scale_interval=scale_interval(data.scale),
        files=data.files,
        **scene_content(data.scene),
        origin_rows=[
            [name.replace("_", " "), MISSING if value is None else str(value)]
            for name, value in {**summary["hardware"], **summary["versions"]}.items()
        ],
    )


def _charts(data: ReportData, summary: dict[str, Any]) -> dict[str, str | None]:
    """Each plot as SVG, None where its data are missing."""
    run, score = data.reconstruction, data.trajectory_score
    times = stage_times(summary["timings_ms"], summary["timing_calls"], summary["wall_s"])
    return {
        "trajectory": plots.trajectory_plot(run, score),
        "ate": plots.ate_plot(score),
        "rpe": plots.rpe_plot(score),
        "position": plots.position_plot(run, score),
        "tracking": plots.tracking_plot(data.steps),
        "scale": plots.scale_plot(run.keyframes),
        "map": plots.map_plot(run),
        "maps": maps_plot(data.maps),
        "speed": speed_plot(times),
    }


def _notes(summary: dict[str, Any]) -> list[str]:
    skipped = summary["skipped_frames"]
    unread = [f"{count(skipped)} images could not be read and were skipped"] if skipped else []
    return [*unread, *summary["notes"]]


def _span_rows(health: dict[str, Any]) -> list[list[str]]:
    """Kind, seconds since the first frame and evidence of each stretch that is worth a look."""
    return [
        [span["kind"], f"{fixed(span['from_s'], 2)} to {fixed(span['to_s'], 2, 's')}", span["why"]]
        for span in health["spans"]
    ]


def _absolute_rows(ate: dict[str, Any]) -> list[list[str]]:
    names = ("rmse_m", "mean_m", "median_m", "max_m")
    return [
        [label, *(fixed(ate[key][name], 4) for name in names), factor]
        for key, label, factor in (
            ("se3", "SE(3): rotation and translation", "1"),
            ("sim3", "Sim(3): and scale", fixed(ate["sim3"]["scale"], 4)),
        )
    ]


def _relative_rows(rpe: dict[str, Any]) -> list[list[str]]:
    rows = []
    for key, label in (("per_frame", "from frame to frame"), ("per_second", "over a second")):
        frames = rpe[key]["delta_frames"]
        span = f"{label}, {frames} poses" if frames and frames > 1 else label
        rows.append([span, fixed(rpe[key]["trans_rmse_m"], 4), fixed(rpe[key]["rot_rmse_deg"], 3)])
    return rows


def _surface_rows(surface: dict[str, Any]) -> list[list[str]]:
    """Figures of the mesh against the sensor's surface in each alignment; none where it was not scored."""
    if surface["sim3"]["points"] is None:
        return []
    return [
        [
            name,
            *(fixed(100 * surface[key][way]["median_m"], 1) for way in ("accuracy", "completion")),
            *(fixed(100 * surface[key][way]["rmse_m"], 1) for way in ("accuracy", "completion")),
            *(fixed(one["f_score"], 2) for one in surface[key]["within"].values()),
            percent(surface[key]["within"]["5cm"]["precision"]),
            percent(surface[key]["within"]["5cm"]["recall"]),
        ]
        for key, name in ALIGNMENTS
    ]


def _depth_rows(depth: dict[str, Any]) -> dict[str, list[str]]:
    """Figures of each way of scaling the depth."""
    ways = ("metric", "sequence_median", "frame_median")
    return {way: [fixed(depth[way][name], 3) for name in _DEPTH_FIGURES] for way in ways}
