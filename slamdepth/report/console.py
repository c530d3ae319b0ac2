# SPDX-License-Identifier: Apache-2.0
"""Tables for a terminal; the command line prints them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from slamdepth.evaluation import Verdict
from slamdepth.evaluation.surface import CUT_M
from slamdepth.report.maps import about_maps, map_lines
from slamdepth.report.text import MISSING, count, fixed, percent

if TYPE_CHECKING:
    from rich.table import Table

    from slamdepth.depth.scale import ScaleFit

    Rows = list[tuple[str, str]]

ALIGNMENTS = (("se3", "SE(3)"), ("sim3", "Sim(3)"))
"""Keys of the figures of a surface, and names of how the poses were aligned."""


def run_table(summary: dict[str, Any]) -> Table:
    """The figures that a run ends with.

    Args:
        summary: of :func:`slamdepth.report.build_summary`.
    """
    rows = [
        *_health_rows(summary["health"]),
        *_frame_rows(summary),
        *_map_rows(summary),
        ("frames per second", fixed(summary["fps"], 1)),
        ("keyframes", count(summary["keyframes"])),
        ("loop closures", count(summary["loop_closures"])),
        ("relocalisations", count(summary["relocalisations"])),
        ("scale", summary["scale"]["sentence"]),
        *_camera_rows(summary["camera"]),
        ("rolling shutter", summary["rolling_shutter"]["sentence"]),
    ]
    is_scored = summary["ate"]["se3"]["rmse_m"] is not None
    rows += _score_rows(summary, 4) if is_scored else [("ATE, RPE", "not scored")]
    depth = summary["depth"]["metric"]
    if depth["abs_rel"] is not None:
        rows.append(("depth", f"AbsRel {fixed(depth['abs_rel'], 3)}, δ < 1.25: {percent(depth['delta1'])}"))
    dense = summary["dense"]
    if dense["keyframes"]:
        rows.append(("depth from many views", f"{percent(dense['measured'])} of the keyframes' pixels"))
    mesh = summary["mesh"]
    if mesh["vertices"] is not None:
        rows.append(("mesh", f"{count(mesh['vertices'])} vertices, {count(mesh['triangles'])} triangles"))
    if summary["surface"]["sim3"]["points"] is not None:
        rows += [(f"mesh, {name}", surface_line(summary["surface"][key])) for key, name in ALIGNMENTS]
    features = f" · features: {summary['features']}" if summary["features"] else ""
    return two_columns(f"{summary['sequence']} · depth: {summary['depth_model']}{features}", rows)


def _health_rows(health: dict[str, Any]) -> Rows:
    """The verdict in one line; where it is not good, the reasons too."""
    reasons = [] if health["verdict"] == Verdict.GOOD.value else health["reasons"]
    return [("verdict", health["headline"]), *(("", reason) for reason in reasons)]


def _camera_rows(camera: dict[str, Any] | None) -> Rows:
    return [] if camera is None else [("camera", camera["sentence"])]


def _frame_rows(summary: dict[str, Any]) -> Rows:
    """Frames and tracked frames; where images could not be read, also the share of all images."""
    frames, tracked, unread = summary["frames"], summary["tracked"], summary["skipped_frames"]
    placed = f"{count(tracked)} ({percent(summary['tracked_fraction'])})"
    in_all = summary["tracked_in_all_maps"]
    if in_all != tracked:
        placed += f" in the largest map, {count(in_all)} ({percent(in_all / frames)}) in all maps"
    readable, all_promised = summary["readable_frames"], summary["promised_frames"]
    promised = ""
    if all_promised != readable:
        promised = f"; the video promises {count(all_promised)} and {count(readable)} can be read"
    if not unread:
        return [("frames", f"{count(frames)}{promised}"), ("tracked", placed)]
    images = frames + unread
    return [
        ("frames", f"{count(frames)} of {count(images)} images; {count(unread)} could not be read{promised}"),
        ("tracked", f"{placed}; {percent(tracked / images)} of all {count(images)} images"),
    ]


def _map_rows(summary: dict[str, Any]) -> Rows:
    """The maps of a run that ended in several, or joined some."""
    maps = summary["maps"]
    about = about_maps(len(maps), summary["maps_joined"])
    if about is None:
        return []
    return [("maps", about), *(map_lines(maps) if len(maps) > 1 else [])]


def trajectory_table(figures: dict[str, Any], title: str = "trajectory", digits: int = 6) -> Table:
    """The figures of ``TrajectoryScore.to_dict()``, with ``digits`` digits after the point."""
    return two_columns(title, _score_rows(figures, digits))


def scale_table(fit: ScaleFit) -> Table:
    """A scale fitted to a sensor, with its uncertainty."""
    unit = fit.scale.domain.shift_unit
    has_shift = fit.shift_sigma is not None or fit.scale.shift != 0.0
    uncertainty = "one frame: unknown" if fit.scale_sigma_log is None else f"± {percent(fit.scale_sigma_log)}"
    rows = [
        (
            f"scale of {fit.scale.domain.value}",
            f"{fit.scale.scale:.4g}{'' if has_shift else f' {uncertainty}'}",
        ),
        ("frames", f"{count(fit.frames)}, {count(fit.pixels)} pixels"),
        ("spread over frames", f"{fit.frame_spread_log:.3f} (std of the log of each frame's own factor)"),
    ]
    if has_shift:
        shift_sigma = MISSING if fit.shift_sigma is None else f"± {fit.shift_sigma:.3g} {unit}"
        rows.insert(1, ("shift", f"{fit.scale.shift:.4g} {shift_sigma}"))
        rows.insert(2, ("depth by both", f"{uncertainty} at the middle depth"))
    return two_columns(f"{fit.model} on {fit.sequence}", rows)


def _score_rows(figures: dict[str, Any], digits: int) -> Rows:
    ate, rpe = figures["ate"], figures["rpe"]
    factor = fixed(ate["sim3"]["scale"], digits)
    matched = f"{count(ate['matched_poses'])} of {count(ate['estimate_poses'])} estimated"
    rows = [
        ("poses compared", f"{matched}, within {ate['max_difference_s']:g} s"),
        ("ATE RMSE, SE(3)", fixed(ate["se3"]["rmse_m"], digits, "m")),
        ("ATE RMSE, Sim(3)", f"{fixed(ate['sim3']['rmse_m'], digits, 'm')} (scale × {factor})"),
    ]
    for key, label in (("per_frame", "RPE per frame"), ("per_second", "RPE per second")):
        trans, rot = rpe[key]["trans_rmse_m"], rpe[key]["rot_rmse_deg"]
        value = MISSING if trans is None else f"{fixed(trans, digits, 'm')}, {fixed(rot, digits, '°')}"
        rows.append((label, value))
    return rows


def surface_line(figures: dict[str, Any]) -> str:
    """The figures of ``SurfaceScore.to_dict()`` in one line."""
    f_scores = ", ".join(f"{fixed(one['f_score'], 2)} at {name}" for name, one in figures["within"].items())
    return (
        f"F {f_scores}; accuracy {_cm(figures['accuracy']['median_m'])}, "
        f"completion {_cm(figures['completion']['median_m'])} (medians)"
    )


def surface_table(figures: dict[str, Any], title: str) -> Table:
    """The figures of ``SurfaceScore.to_dict()``."""
    rows = []
    for name in ("accuracy", "completion"):
        one = figures[name]
        rows.append(
            (
                name,
                f"median {_cm(one['median_m'])}, mean {_cm(one['mean_m'])}, RMSE {_cm(one['rmse_m'])} "
                f"(distances capped at {100 * CUT_M:g} cm)",
            )
        )
    rows.append(("chamfer", _cm(figures["chamfer_m"])))
    for name, one in figures["within"].items():
        rows.append(
            (
                f"within {name.replace('cm', ' cm')}",
                f"F {fixed(one['f_score'], 3)}, precision {percent(one['precision'])}, recall "
                f"{percent(one['recall'])}",
            )
        )
    rows.append(("judged", f"{percent(figures['judged'])} of the mesh, {count(figures['points'])} points"))
    return two_columns(title, rows)


def _cm(distance_m: float | None) -> str:
    return fixed(None if distance_m is None else 100 * distance_m, 2, "cm")


def two_columns(title: str, rows: Rows) -> Table:
    """A table of names and values, shown as they are: brackets in a path are no markup."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title, style="bold"), title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(Text(name), Text(value))
    return table
