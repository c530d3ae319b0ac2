# SPDX-License-Identifier: Apache-2.0
"""Plots of runs side by side: paths over one another, errors over time, bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import transform
from slamdepth.report import figure as fig
from slamdepth.report.axes import drawing_views
from slamdepth.report.compare.comparison import Comparison
from slamdepth.report.gaps import gap_ends, with_gaps

if TYPE_CHECKING:
    from slamdepth.report.scene.model import SceneMap
    from slamdepth.typing import Floats

COLOURS = (fig.ESTIMATE, fig.SCALED, fig.GOOD, fig.BAD, fig.TRUTH, fig.MUTED)
_STYLES = ("-", "--", "-.", ":")
_WIDTH = 9.6
_BARS = ("frames per second", "ATE SE(3), RMSE (m)", "ATE Sim(3), RMSE (m)", "mesh Sim(3): F at 5 cm")


def look_of(number: int) -> tuple[str, str]:
    """Colour and style of a run's line."""
    return COLOURS[number % len(COLOURS)], _STYLES[number // len(COLOURS) % len(_STYLES)]


def paths_plot(found: Comparison) -> str | None:
    """The largest map of each run from above and from the side, aligned to that of the first by Sim(3)."""
    first = found.runs[0].scene.maps[0]
    if len(first.path) == 0:
        return None
    lines = []
    if first.truth is not None:
        truth = first.truth.T_world_camera[:, :3, 3]
        lines.append((with_gaps(first.truth.timestamps_s, truth), fig.TRUTH, ":", "ground truth", 1.0))
    for n, (name, run, score) in enumerate(zip(found.names, found.runs, found.to_first, strict=True)):
        path = run.scene.maps[0].path
        points = path.T_world_camera[:, :3, 3]
        if n > 0:
            if score is None:
                continue
            points = transform(score.sim3.T_truth_estimate, points)
        colour, style = look_of(n)
        lines.append((with_gaps(path.timestamps_s, points), colour, style, name, 1.4))
    views = drawing_views(first.gravity_w)
    with fig.styled("paths"):
        figure, axes = fig.new_figure(_WIDTH, 4.7, 1, 2)
        for panel, view in zip(axes[0], views, strict=True):
            for points, colour, style, label, width in lines:
                panel.plot(*view.flat(points).T, style, color=colour, label=label, lw=width)
            view.frame(panel, view.flat(np.concatenate([line[0] for line in lines])))
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
        return fig.to_svg(figure, "Paths over one another")


def errors_plot(found: Comparison) -> str | None:
    """Distance of each pose from the ground truth over time; None where no run has one."""
    curves = [
        (n, *_error(one))
        for n, run in enumerate(found.runs)
        if (one := run.scene.maps[0]).truth is not None and len(one.path)
    ]
    if not curves:
        return None
    start = min(float(times[0]) for _, times, _ in curves)
    with fig.styled("errors"):
        figure, axes = fig.new_figure(_WIDTH, 2.9)
        panel = axes[0, 0]
        for n, times, errors in curves:
            colour, style = look_of(n)
            values = with_gaps(times, 100 * errors[:, None])[:, 0]
            at = np.insert(times, gap_ends(times), np.nan) - start
            panel.plot(at, values, style, color=colour, label=found.names[n])
        panel.set(xlabel="time (s)", ylabel="distance (cm)", ylim=(0, None))
        fig.legend_above(panel, columns=min(4, len(curves)))
        return fig.to_svg(figure, "Distance from the ground truth over time")


def bars_plot(found: Comparison) -> str | None:
    """Speed and errors as bars; None where no run has such a figure."""
    rows = [row for row in found.figures if row.name in _BARS]
    if not rows:
        return None
    count = len(found.names)
    with fig.styled("bars"):
        figure, axes = fig.new_figure(_WIDTH, 0.7 + 0.3 * count, 1, len(rows), sharey=True)
        for panel, row in zip(axes[0], rows, strict=True):
            values = [0.0 if value is None else float(value) for value in row.values]
            colours = [look_of(n)[0] for n in range(count)]
            panel.barh(range(count), values, color=colours, height=0.62)
            for n, text in enumerate(row.shown):
                panel.annotate(text, (values[n], n), xytext=(3, 0), textcoords="offset points", va="center")
            panel.set(title=row.name, xlim=(0, 1.3 * max([*values, 1e-9])), xticks=[])
            panel.set_yticks(range(count), found.names)
            panel.grid(False)
            panel.spines[["bottom"]].set_visible(False)
        axes[0, 0].invert_yaxis()
        return fig.to_svg(figure, "Speed, trajectory errors and mesh score of each run")


def _error(one: SceneMap) -> tuple[Floats, Floats]:
    """Times and distances of the poses from the ground truth, which is aligned to the map by SE(3)."""
    assert one.truth is not None
    times = one.truth.timestamps_s
    at = np.clip(np.searchsorted(one.path.timestamps_s, times - 1e-4), 0, len(one.path) - 1)
    gap = one.path.T_world_camera[at, :3, 3] - one.truth.T_world_camera[:, :3, 3]
    return times, np.linalg.norm(gap, axis=1)
