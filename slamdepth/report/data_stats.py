# SPDX-License-Identifier: Apache-2.0
"""Data sets with depth side by side: histograms, a page, and tables for a terminal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.evaluation.depth_statistics import DepthStatistics
from slamdepth.io import replacing, write_text
from slamdepth.report.figure import new_figure, to_png
from slamdepth.report.keyframe_images import near_to_far
from slamdepth.report.page import data_address, render
from slamdepth.report.text import MISSING, count, fixed, percent
from slamdepth.types import Camera

if TYPE_CHECKING:
    from rich.console import JustifyMethod
    from rich.table import Table

HISTOGRAMS, PAGE = "histograms.png", "data-stats.html"
_INK, _MUTED, _RULE, _BAR = "#14181f", "#5b6575", "#dfe3e9", "#9aa5b4"
_BINS = 80
_LONGEST_NAME = 32
"""Longer names are broken in a terminal's table, so that numbers stay whole."""
_DEPTHS = (
    ("min", "min_m"), ("1 %", "p1_m"), ("5 %", "p5_m"), ("median", "p50_m"),
    ("95 %", "p95_m"), ("99 %", "p99_m"), ("max", "max_m"),
)  # fmt: skip


@dataclass(frozen=True)
class DataRow:
    """A data set, counted.

    Attributes:
        name: of the data set.
        camera: its camera.
        size: number of images it has, counted or not.
        statistics: of the images that were counted.
        notes: what was guessed, repaired or left out, one line each.
    """

    name: str
    camera: Camera
    size: int
    statistics: DepthStatistics
    notes: tuple[str, ...] = ()


def looked_at(images: int, size: int) -> str:
    """The number of pairs of a data set, and how many of them were counted, unless all were."""
    return count(size) if images == size else f"{count(images)} of {count(size)}"


def overview_rows(about: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows: number, size, lens and sparsity of each data set of ``data-stats.json``."""
    heads = ["data set", "pairs", "pixels", "f (px)", "view", "no depth", "per image"]
    rows = []
    for one in about["sets"]:
        spread = one["without_depth_per_image"]
        rows.append(
            [
                one["name"],
                looked_at(one["images"], one["pairs"]),
                f"{one['width']}x{one['height']}",
                fixed(one["fx"], 0),
                fixed(one["view_deg"], 0) + "°",
                percent(one["without_depth"]),
                MISSING if spread is None else f"{100 * spread['min']:.0f}–{100 * spread['max']:.0f} %",
            ]
        )
    return heads, rows


def range_rows(about: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Heads and rows: the depths of each data set in metres."""
    heads = ["depth (m)", *(label for label, _ in _DEPTHS)]
    return heads, [[one["name"], *(fixed(one[key], 2) for _, key in _DEPTHS)] for one in about["sets"]]


def data_tables(about: dict[str, Any]) -> list[Table]:
    """Both tables for a terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    tables = []
    for heads, rows in (overview_rows(about), range_rows(about)):
        shown = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
        names_stay = max(len(row[0]) for row in rows) <= _LONGEST_NAME
        for number, head in enumerate(heads):
            justify: JustifyMethod = "right" if number else "left"
            shown.add_column(head, justify=justify, overflow="fold", no_wrap=not number and names_stay)
        for row in rows:
            shown.add_row(*map(Text, row))
        tables.append(shown)
    return tables


def write_data_page(folder: Path, rows: list[DataRow], about: dict[str, Any]) -> None:
    """Write ``histograms.png`` and ``data-stats.html``, which needs nothing else, into ``folder``.

    Raises:
        OutputError: a file cannot be written.
    """
    png = histogram_image(rows)
    with replacing(folder / HISTOGRAMS) as temporary:
        temporary.write_bytes(png)
    write_text(folder / PAGE, _page(png, about))


def histogram_image(rows: list[DataRow]) -> bytes:
    """A PNG: a histogram of depth for each data set over one axis, and next to it the sparsity."""
    import matplotlib

    style = {
        "font.family": ["DejaVu Sans"], "font.size": 9.0,
        "axes.spines.top": False, "axes.spines.right": False,
        "axes.edgecolor": _RULE, "axes.labelcolor": _MUTED, "xtick.color": _RULE, "ytick.color": _RULE,
        "xtick.labelcolor": _MUTED, "ytick.labelcolor": _MUTED, "text.color": _INK, "axes.axisbelow": True,
    }  # fmt: skip
    edges_m = np.unique(np.round(np.geomspace(*_axis_ends_m(rows), _BINS + 1), 3))
    with matplotlib.rc_context(style):
        height = 0.75 + 1.05 * len(rows)
        figure, axes = new_figure(9.6, height, len(rows), 2, sharex="col", width_ratios=(5, 1.15))
        colours = near_to_far()
        for (left, right), row in zip(axes, rows, strict=True):
            _histogram(left, row, edges_m, colours)
            _sparsity(right, row)
        axes[0, 0].set_xlim(edges_m[0], edges_m[-1])
        _depth_axis(axes[0, 0])
        axes[-1, 0].set_xlabel(
            "depth (m), logarithmic; height: share of the known pixels; black: 5 % to 95 %, dot: median"
        )
        axes[-1, 1].set_xlabel("pixels without depth (%)")
        axes[0, 1].set_xlim(0, 100)
        return to_png(figure, dpi=150)


def _axis_ends_m(rows: list[DataRow]) -> tuple[float, float]:
    """Ends of the depth axis: all but the outermost hundredths of every data set are on it."""
    nearest = [row.statistics.percentile_m(1.0) or 1.0 for row in rows]
    farthest = [row.statistics.percentile_m(99.0) or 1.0 for row in rows]
    return max(0.8 * min(nearest), 0.02), 1.15 * max(farthest)


def _histogram(panel: Any, row: DataRow, edges_m: Any, colours: Any) -> None:
    known = max(row.statistics.known, 1)
    shares = row.statistics.histogram(edges_m) / known
    widths = np.diff(edges_m)
    places = np.linspace(0.0, 1.0, len(shares))
    panel.bar(edges_m[:-1], shares, widths, align="edge", color=colours(places), lw=0)
    top = 1.42 * max(float(shares.max()), 1e-9)
    low, middle, high = (row.statistics.percentile_m(p) for p in (5, 50, 95))
    if low is not None and middle is not None and high is not None:
        panel.plot([low, high], [0.82 * top] * 2, color=_INK, lw=1.2, solid_capstyle="butt")
        panel.plot([middle], [0.82 * top], "o", color=_INK, ms=4)
    panel.set(ylim=(0, top), yticks=[])
    panel.spines["left"].set_visible(False)
    panel.grid(axis="x", color=_RULE, lw=0.6)
    camera = row.camera
    pairs = looked_at(row.statistics.images, row.size)
    facts = f"{pairs} pairs, {camera.width}x{camera.height}, f {camera.fx:.0f} px"
    panel.set_title(row.name, loc="left", fontsize=9.5, fontweight="bold", pad=2)
    panel.set_title(facts, loc="right", fontsize=8.5, color=_MUTED, pad=2)


def _depth_axis(panel: Any) -> None:
    """A logarithmic axis with round metres; shared by all rows."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = panel.get_xlim()
    metres = [m * 10.0**power for power in range(-2, 4) for m in (1, 2, 5)]
    panel.set_xscale("log")
    panel.set_xlim(low, high)
    panel.xaxis.set_major_locator(FixedLocator([m for m in metres if low <= m <= high]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.xaxis.set_minor_locator(NullLocator())


def _sparsity(panel: Any, row: DataRow) -> None:
    """The share over all pixels as a bar, and a line from the densest to the sparsest image."""
    missing = 100.0 * (1.0 - row.statistics.known / max(row.statistics.pixels, 1))
    images = [100.0 * (1.0 - share) for share in row.statistics.known_shares]
    panel.barh([0], [missing], 0.5, color=_BAR)
    panel.plot([min(images), max(images)], [0, 0], color=_INK, lw=1.0)
    panel.text(2, 0.62, f"{missing:.1f} %", fontsize=8.5, va="center")
    panel.set(ylim=(-0.8, 0.9), yticks=[], xticks=[0, 50, 100])
    panel.spines["left"].set_color(_MUTED)


def _page(png: bytes, about: dict[str, Any]) -> str:
    return render(
        "data_stats.html.j2",
        about=about,
        histograms=data_address(png, "image/png"),
        overview=overview_rows(about),
        ranges=range_rows(about),
        notes=[f"{one['name']}: {note}" for one in about["sets"] for note in one["notes"]],
    )
