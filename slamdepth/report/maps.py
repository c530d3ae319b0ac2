# SPDX-License-Identifier: Apache-2.0
"""What a report says of each map of a run. Maps that never met have no common frame and no common scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.evaluation import TrajectoryScore
from slamdepth.geometry import invert, transform
from slamdepth.report import figure as fig
from slamdepth.report.axes import drawing_views
from slamdepth.report.data import MapData, ReportData
from slamdepth.report.gaps import with_gaps
from slamdepth.report.text import MISSING, count, fixed, percent
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from slamdepth.types import Trajectory

_PAUSE_S = 1.0  # and 2.5 times the spacing of frames: shorter ones do not end a stretch
_SHOWN = 3  # stretches named in one line
_COLUMNS, _DRAWN = 3, 9
_PANEL = 3.2  # inches

MAP_HEADS = ("map", "seconds", "frames", "keyframes", "path (m)", "extent (m)", "scale", "ATE SE(3) (m)",
             "ATE Sim(3) (m)", "verdict")  # fmt: skip
"""Heads of :func:`map_rows`."""


def first_timestamp_s(data: ReportData) -> float | None:
    """Time of the first frame, from which spans are counted; None without frames."""
    if data.steps:
        return data.steps[0].timestamp_s
    starts = [
        float(times[0]) for one in data.maps if len(times := one.reconstruction.trajectory.timestamps_s)
    ]
    return min(starts, default=None)


def map_figures(data: ReportData) -> list[dict[str, Any]]:
    """The figures of each map, the largest first, as nested plain values."""
    start_s = first_timestamp_s(data) or 0.0
    frames = data.reconstruction.statistics.frames
    return [
        {
            "number": number,
            "folder": "." if number == 1 else f"maps/{number}",
            "stretches_s": _stretches(one.reconstruction.trajectory, start_s),
            "frames": len(one.reconstruction.trajectory),
            "share": len(one.reconstruction.trajectory) / frames if frames else None,
            "keyframes": len(one.reconstruction.keyframes),
            **_size(one.reconstruction.trajectory),
            "scale": one.scale.to_dict(),
            **trajectory_figures(one.trajectory_score),
            "mesh": mesh_figures(one),
            "verdict": health.verdict.value,
        }
        for number, (one, health) in enumerate(zip(data.maps, data.health.maps, strict=True), start=1)
    ]


def mesh_figures(one: MapData) -> dict[str, int | None]:
    """Vertices and triangles of a map's mesh; None where there is none."""
    return {
        "vertices": one.mesh.vertices if one.mesh else None,
        "triangles": one.mesh.triangles if one.mesh else None,
    }


def trajectory_figures(score: TrajectoryScore | None) -> dict[str, Any]:
    """``ate`` and ``rpe`` of a path, with the same keys where it was not scored."""
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


def _stretches(trajectory: Trajectory, start_s: float) -> list[list[float]]:
    """From and to of each stretch without a long pause, seconds since the first frame."""
    times_s = trajectory.timestamps_s - start_s
    if not len(times_s):
        return []
    spacing = np.diff(times_s)
    pause_s = max(_PAUSE_S, 2.5 * float(np.median(spacing))) if len(spacing) else _PAUSE_S
    parts = np.split(times_s, np.flatnonzero(spacing > pause_s) + 1)
    return [[float(part[0]), float(part[-1])] for part in parts]


def _size(trajectory: Trajectory) -> dict[str, float | None]:
    """Length of the path, and the diagonal of its bounding box."""
    if not len(trajectory):
        return {"path_m": None, "extent_m": None}
    positions = trajectory.T_world_camera[:, :3, 3]
    return {
        "path_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "extent_m": float(np.linalg.norm(np.ptp(positions, axis=0))),
    }


def map_rows(maps: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One row of :data:`MAP_HEADS` for each of :func:`map_figures`."""
    return [
        [
            f"{one['number']}, the largest" if one["number"] == 1 else str(one["number"]),
            _when(one["stretches_s"]),
            f"{count(one['frames'])} ({percent(one['share'])})",
            count(one["keyframes"]),
            fixed(one["path_m"], 2),
            fixed(one["extent_m"], 2),
            _scale(one["scale"]),
            fixed(one["ate"]["se3"]["rmse_m"], 4),
            fixed(one["ate"]["sim3"]["rmse_m"], 4),
            one["verdict"],
        ]
        for one in maps
    ]


def map_lines(maps: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Name and figures of each map in one line, for a terminal."""
    lines = []
    for name, when, frames, keyframes, path, extent, scale, _, sim3, verdict in map_rows(maps):
        error = "" if sim3 == MISSING else f" · ATE Sim(3) {sim3} m"
        lines.append(
            (
                f"  map {name}",
                f"{when} s · {frames} frames · {keyframes} keyframes · path {path} m, {extent} m across · "
                f"scale {scale}{error} · {verdict}",
            )
        )
    return lines


def about_maps(maps: int, joined: int) -> str | None:
    """How many maps a run ended with; None where it had a single one from the start."""
    together = f"; two maps met and were joined {count(joined)} {'time' if joined == 1 else 'times'}"
    if maps > 1:
        never = f"{count(maps)} that never met: no common frame, each with its own scale"
        return f"{never}{together if joined else ''}"
    return f"1{together}" if joined else None


def _when(stretches: Sequence[Sequence[float]]) -> str:
    named = ", ".join(f"{from_s:.1f}-{to_s:.1f}" for from_s, to_s in stretches[:_SHOWN])
    return f"{named}, ..." if len(stretches) > _SHOWN else named or MISSING


def _scale(scale: dict[str, Any]) -> str:
    """The factor on the depth model's lengths, and the interval of lengths in two cases of three."""
    found = scale["interval"]
    sure = "accuracy unknown" if found is None else f"{found[0]:.2f} to {found[1]:.2f} of true metres"
    return f"× {scale['factor']:.3g}, {sure}"


def maps_plot(maps: Sequence[MapData]) -> str | None:
    """Each map from above in axes of its own; None for a single map."""
    drawn = [(n, one) for n, one in enumerate(maps, start=1) if len(one.reconstruction.trajectory)][:_DRAWN]
    if len(maps) < 2 or not drawn:
        return None
    columns = min(_COLUMNS, len(drawn))
    rows = -(-len(drawn) // columns)
    with fig.styled("maps"):
        figure, axes = fig.new_figure(_PANEL * columns, 1.1 * _PANEL * rows, rows, columns)
        for panel in axes.flat[len(drawn) :]:
            panel.set_axis_off()
        for panel, (number, one) in zip(axes.flat, drawn, strict=False):
            _draw(panel, number, one)
        handles = {label: handle for panel in axes.flat for handle, label in zip(
            *panel.get_legend_handles_labels(), strict=True)}  # fmt: skip
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
        return fig.to_svg(figure, f"{len(drawn)} maps, each in a frame of its own")


def _draw(panel: Any, number: int, one: MapData) -> None:
    run, score = one.reconstruction, one.trajectory_score
    view, _ = drawing_views(run.gravity_w)
    path = run.trajectory.T_world_camera[:, :3, 3]
    lines: list[tuple[Floats, str, str]] = []
    if score is not None:
        truth = transform(invert(score.se3.T_truth_estimate), score.truth_m)
        lines.append((with_gaps(score.timestamps_s, truth), fig.TRUTH, "ground truth"))
    lines.append((with_gaps(run.trajectory.timestamps_s, path), fig.ESTIMATE, "estimate"))
    for positions, colour, label in lines:
        panel.plot(*view.flat(positions).T, color=colour, label=label)
    panel.plot(*view.flat(path[:1]).T, "o", color=fig.INK, ms=4, label="start")
    view.frame(panel, view.flat(np.concatenate([line[0] for line in lines])), f"map {number}")
