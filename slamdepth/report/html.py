# SPDX-License-Identifier: Apache-2.0
"""One self-contained page that shows and explains a run."""

from __future__ import annotations

from html import escape
from importlib import resources
from typing import Any

from slamdepth.report import plots
from slamdepth.report.axes import about_views
from slamdepth.report.data import ReportData
from slamdepth.report.keyframe_images import NEAR_TO_FAR, UNKNOWN, Gallery, jpeg_address, keyframe_gallery
from slamdepth.report.markup import collapsed, plot, section, settings_table, table, tile
from slamdepth.report.speed import speed_caption, speed_plot, stage_times
from slamdepth.report.text import MISSING, count, fixed, percent


def build_html(data: ReportData, summary: dict[str, Any]) -> str:
    """The page as one string: no scripts, nothing loaded from elsewhere."""
    css = resources.files("slamdepth.report").joinpath("report.css").read_text(encoding="utf-8")
    parts = (
        _header(summary),
        _tiles(summary),
        _notes(summary),
        _trajectory(data, summary),
        _tracking(data, summary),
        _depth(data, summary),
        _map(data, summary),
        _speed(summary),
        _provenance(data, summary),
    )
    title = escape(f"{summary['sequence']} · slamdepth")
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n"
        f"{''.join(parts)}</main>\n</body>\n</html>\n"
    )


def _header(summary: dict[str, Any]) -> str:
    depth = "sensor depth" if summary["depth_model"] == "sensor" else f"depth by {summary['depth_model']}"
    features = f", {summary['features']} features" if summary["features"] else ""
    lead = f"{depth}{features} · {count(summary['frames'])} frames. {summary['scale']['sentence']}"
    return (
        f'<header><div class="product">slamdepth {escape(str(summary["versions"]["slamdepth"]))} · run report'
        f"</div><h1>{escape(summary['sequence'])}</h1>"
        f'<p class="lead">{escape(lead)}</p></header>\n'
    )


def _tiles(summary: dict[str, Any]) -> str:
    ate = summary["ate"]
    frames = f"{count(summary['tracked'])} of {count(summary['frames'])} frames"
    loops, relocated = count(summary["loop_closures"]), count(summary["relocalisations"])
    tiles = [
        tile("tracked", percent(summary["tracked_fraction"]), frames),
        tile("speed", fixed(summary["fps"], 1, "fps"), "tracking, depth and optimisation"),
        tile(
            "keyframes", count(summary["keyframes"]), f"loops closed: {loops}, relocalisations: {relocated}"
        ),
    ]
    if summary["mesh"]["triangles"] is not None:
        vertices = f"{count(summary['mesh']['vertices'])} vertices"
        tiles.append(tile("mesh", count(summary["mesh"]["triangles"]), f"triangles, {vertices}"))
    if ate["se3"]["rmse_m"] is not None:
        metric, scaled = ate["se3"]["rmse_m"], ate["sim3"]["rmse_m"]
        is_given = summary["scale"]["from_ground_truth"]
        how = "scale from ground truth: no metric claim" if is_given else "scale as estimated"
        tiles += [
            tile("ATE, SE(3)", fixed(100 * metric, 2, "cm"), f"RMSE, {how}"),
            tile("ATE, Sim(3)", fixed(100 * scaled, 2, "cm"), "RMSE, scale corrected"),
            tile("scale", f"× {fixed(ate['sim3']['scale'], 3)}", "would correct the estimate"),
        ]
    depth = summary["depth"]["metric"]
    if depth["abs_rel"] is not None:
        tiles.append(
            tile("depth AbsRel", fixed(depth["abs_rel"], 3), f"{_as_predicted(summary)}, against the sensor")
        )
    return f'<div class="tiles">{"".join(tiles)}</div>\n'


def _as_predicted(summary: dict[str, Any]) -> str:
    """Predictions are judged as the tracker saw them."""
    scale = summary["scale"]
    is_scaled = scale["prediction_factor"] != 1.0 or scale["shift"] is not None
    return "as predicted, depth scale applied" if is_scaled else "as predicted"


def _notes(summary: dict[str, Any]) -> str:
    notes = list(summary["notes"])
    if summary["skipped_frames"]:
        notes.insert(0, f"{count(summary['skipped_frames'])} images could not be read and were skipped")
    if not notes:
        return ""
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return section("Notes", "What was guessed, dropped or repaired during this run.", f"<ul>{items}</ul>")


def _trajectory(data: ReportData, summary: dict[str, Any]) -> str:
    score = data.trajectory_score
    body = plot(
        plots.trajectory_plot(data.reconstruction, score),
        f"The path after optimisation. {about_views(data.reconstruction.gravity_w)}"
        + (" Thin lines join each pose to its ground truth, aligned by SE(3)." if score else ""),
    )
    if score is None:
        intro = "This run was not scored against a ground truth."
    else:
        ate = summary["ate"]
        intro = (
            f"{count(ate['matched_poses'])} of {count(ate['estimate_poses'])} estimated poses have a ground "
            f"truth pose within {1000 * ate['max_difference_s']:g} ms and are scored, over a path of "
            f"{fixed(ate['path_length_m'], 2, 'm')}. Every tracked frame counts, not keyframes alone."
        )
        body += _error_tables(summary)
        body += plot(
            plots.ate_plot(score),
            "Distance of each pose from the ground truth after one alignment of the whole path, "
            "without scale (SE(3)) and with it (Sim(3)). Dotted: RMSE.",
        )
        body += plot(plots.rpe_plot(score), "Drift: error of the relative motion. Dotted: RMSE.")
    body += plot(
        plots.position_plot(data.reconstruction, score),
        "Each coordinate of the camera in the frame of the first camera.",
    )
    return section("Trajectory", intro, body)


def _error_tables(summary: dict[str, Any]) -> str:
    ate, rpe = summary["ate"], summary["rpe"]
    names = ("rmse_m", "mean_m", "median_m", "max_m")
    rows = [
        [label, *(fixed(ate[key][name], 4) for name in names), factor]
        for key, label, factor in (
            ("se3", "SE(3): rotation and translation", "1"),
            ("sim3", "Sim(3): and scale", fixed(ate["sim3"]["scale"], 4)),
        )
    ]
    absolute = table(
        ["ATE after alignment by", "RMSE (m)", "mean (m)", "median (m)", "max (m)", "scale"], rows
    )
    spans = (("per_frame", "from frame to frame"), ("per_second", "over a second"))
    rows = []
    for key, label in spans:
        frames = rpe[key]["delta_frames"]
        span = f"{label}, {frames} poses" if frames and frames > 1 else label
        rows.append([span, fixed(rpe[key]["trans_rmse_m"], 4), fixed(rpe[key]["rot_rmse_deg"], 3)])
    return absolute + table(["RPE", "translation RMSE (m)", "rotation RMSE (°)"], rows)


def _tracking(data: ReportData, summary: dict[str, Any]) -> str:
    rows = [
        ["frames tracked", f"{count(summary['tracked'])} of {count(summary['frames'])}"],
        ["keyframes", count(summary["keyframes"])],
        ["loop closures", count(summary["loop_closures"])],
        ["relocalisations after loss", count(summary["relocalisations"])],
        ["frames placed by point-cloud registration", count(summary["registrations"])],
        ["rolling shutter", summary["rolling_shutter"]["sentence"]],
    ]
    strip = plot(
        plots.tracking_plot(data.steps),
        "State after each frame, keyframes as ticks, and how many map points agree with each pose.",
    )
    return section("Tracking", "How well the camera was followed.", strip + table([], rows))


def _depth(data: ReportData, summary: dict[str, Any]) -> str:
    score, body = summary["depth"], ""
    if data.depth_score is None:
        is_sensor = summary["depth_model"] == "sensor"
        intro = (
            "The depth of the sensor itself." if is_sensor else "This depth was not compared with a sensor."
        )
    else:
        intro = (
            f"{count(score['frames'])} depth maps against the sensor of the same frames; "
            f"{percent(score['coverage'])} of the sensor's pixels have a depth here. "
            "Each figure is the mean over frames."
        )
        ways = (
            ("metric", _as_predicted(summary)),
            ("sequence_median", f"one factor for the sequence, {fixed(score['sequence_scale'], 3)}"),
            ("frame_median", "one factor for each frame"),
        )
        figures = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3")
        rows = [[label, *(fixed(score[way][name], 3) for name in figures)] for way, label in ways]
        heads = ["scaled by", "AbsRel", "RMSE (m)", "RMSE log", "δ < 1.25", "δ < 1.25²", "δ < 1.25³"]
        body += table(heads, rows)
        body += (
            '<p class="why">AbsRel is the mean relative error, δ the share of pixels within that ratio. '
            f"From frame to frame the best factor wobbles by {percent(score['frame_scale_spread'])} "
            "(standard deviation of its logarithm).</p>"
        )
    body += plot(
        plots.scale_plot(data.reconstruction.keyframes),
        "Factor that turned each keyframe's prediction into metres of the map; steady is good.",
    )
    gallery = keyframe_gallery(data.reconstruction.keyframes)
    return section("Depth", intro, body + (_gallery(gallery) if gallery else ""))


def _gallery(gallery: Gallery) -> str:
    gradient = f"linear-gradient(to right, {', '.join(NEAR_TO_FAR)})"
    bar = (
        f'<div class="colourbar"><span>{gallery.near_m:.1f} m</span>'
        f'<span class="bar" style="background: {gradient}"></span><span>{gallery.far_m:.1f} m</span>'
        f'<span class="unknown" style="background: {UNKNOWN}"></span><span>unknown or dropped</span></div>'
    )
    figures, three = [], any(picture.sensor for picture in gallery.pictures)
    for picture in gallery.pictures:
        shown = [("image", picture.image), ("depth", picture.depth)]
        shown += [("sensor depth", picture.sensor)] if picture.sensor else []
        images = "".join(f'<img src="{src}" alt="{name} of keyframe {picture.id}">' for name, src in shown)
        names = " | ".join(name for name, _ in shown)
        figures.append(
            f'<figure><div class="pair">{images}</div>'
            f"<figcaption>keyframe {picture.id}, at {picture.seconds:.2f} s: {names}</figcaption></figure>"
        )
    kind = "gallery three" if three else "gallery"
    return f'<h3>Some keyframes</h3>{bar}<div class="{kind}">{"".join(figures)}</div>'


def _map(data: ReportData, summary: dict[str, Any]) -> str:
    rows = [
        ["sparse map points", count(len(data.reconstruction.points_m))],
        ["mesh vertices", count(summary["mesh"]["vertices"])],
        ["mesh triangles", count(summary["mesh"]["triangles"])],
    ]
    intro = "Sparse points come from tracking, the mesh from fusing the keyframes' depth."
    chart = plot(
        plots.map_plot(data.reconstruction),
        "Sparse points (grey), the path, and the keyframes as dots. "
        + about_views(data.reconstruction.gravity_w),
    )
    return section("Map", intro, chart + _mesh(data) + table([], rows))


def _mesh(data: ReportData) -> str:
    if not data.mesh_pictures:
        return '<p class="why">There is no mesh, so there is no picture of one.</p>' if not data.mesh else ""
    figures = "".join(
        f'<figure><img src="{jpeg_address(picture.image_rgb)}" alt="{escape(picture.title)}">'
        f"<figcaption><b>{escape(picture.title)}.</b> {escape(picture.caption)}</figcaption></figure>"
        for picture in data.mesh_pictures
    )
    return f'<h3>The mesh</h3><div class="gallery">{figures}</div>'


def _speed(summary: dict[str, Any]) -> str:
    times = stage_times(summary["timings_ms"], summary["timing_calls"], summary["wall_s"])
    chart = plot(speed_plot(times), speed_caption(summary["wall_s"]))
    intro = (
        f"{fixed(summary['fps'], 1)} frames a second: all frames over the wall time of tracking, depth "
        "prediction and optimisation; meshing is apart."
    )
    return section("Speed", intro, chart)


def _provenance(data: ReportData, summary: dict[str, Any]) -> str:
    body = f"<h3>Scale</h3><p>{escape(summary['scale']['sentence'])}</p><h3>Weights</h3>"
    if summary["weights"]:
        rows = [[w["name"], w["trained_on"], w["licence"], w["sha256"]] for w in summary["weights"]]
        body += table(["weights", "data they have seen", "licence", "sha256"], rows, text=True)
    else:
        body += "<p>No network took part in this run.</p>"
    if data.files:
        body += "<h3>Files beside this page</h3>"
        body += table([], [[name, holds] for name, holds in data.files.items()], text=True)
    run_on = {**summary["hardware"], **summary["versions"]}
    facts = [[name.replace("_", " "), MISSING if v is None else str(v)] for name, v in run_on.items()]
    if summary["options"]:
        body += collapsed("Options of the command", settings_table(summary["options"]))
    body += collapsed("All settings", settings_table(summary["settings"]))
    body += collapsed("Versions and hardware", table([], facts, text=True))
    return section("Where this comes from", "What it takes to repeat this run and to judge it.", body)
