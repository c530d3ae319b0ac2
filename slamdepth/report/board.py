# SPDX-License-Identifier: Apache-2.0
"""Pictures for the calibration of a camera: the board to print, and where its corners were seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamdepth.boards.adjust import Fit
from slamdepth.boards.board import Board
from slamdepth.boards.choose import View
from slamdepth.errors import ConfigError
from slamdepth.io import replacing
from slamdepth.report.figure import write_png
from slamdepth.typing import Bools

PAPERS_MM = {"a4": (297.0, 210.0), "letter": (279.4, 215.9)}
"""Longer and shorter side."""

_MM_PER_INCH = 25.4
_EDGE_MM = 6.0
"""What printers leave white."""
_FOOT_MM = 20.0
_RULER_MM = 100.0


def write_board(path: Path, board: Board, paper: str = "a4") -> None:
    """Write ``board`` as a PDF of one page in its exact size, with a line of 100 mm to check the print by.

    Args:
        paper: a name of :data:`PAPERS_MM`; the page lies or stands as the board needs.

    Raises:
        ConfigError: the paper is unknown or too small.
        OutputError: ``path`` cannot be written.
    """
    if paper.lower() not in PAPERS_MM:
        raise ConfigError(f"--paper {paper}: known are {', '.join(PAPERS_MM)}")
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    black, cell_mm = board.is_black()
    height, width = (cell_mm * side for side in black.shape)
    long_mm, short_mm = PAPERS_MM[paper.lower()]
    pages = [(long_mm, short_mm), (short_mm, long_mm)]
    page = next(
        (p for p in pages if width <= p[0] - 2 * _EDGE_MM and height <= p[1] - _EDGE_MM - _FOOT_MM), None
    )
    if page is None:
        raise ConfigError(
            f"a board of {width:g} x {height:g} mm does not fit on {paper}: smaller squares (--square-mm) or "
            "fewer of them (--board)"
        )
    left, bottom = (page[0] - width) / 2.0, _FOOT_MM + (page[1] - _EDGE_MM - _FOOT_MM - height) / 2.0
    corners = [
        [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        for x0, y0, x1, y1 in (
            (
                left + cell_mm * a,
                bottom + height - cell_mm * b,
                left + cell_mm * c,
                bottom + height - cell_mm * d,
            )
            for a, b, c, d in _rectangles(black)
        )
    ]
    with rc_context({"pdf.fonttype": 42, "font.family": ["DejaVu Sans"]}):
        figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
        FigureCanvasPdf(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, page[0]), ylim=(0.0, page[1]))
        axes.set_axis_off()
        axes.add_collection(PolyCollection(corners, facecolors="black", edgecolors="none", antialiased=False))
        start = _EDGE_MM + 6.0
        for x in (start, start + _RULER_MM):
            axes.plot([x, x], [9.0, 13.0], color="black", linewidth=0.6)
        axes.plot([start, start + _RULER_MM], [11.0, 11.0], color="black", linewidth=0.6)
        axes.text(
            start + _RULER_MM + 4.0, 11.0,
            f"The line is {_RULER_MM:g} mm long: print at 100 %, not fitted to the page.\n"
            f"slamdepth calibrate VIDEO --board {board.name} --square-mm {board.square_mm:g}",
            fontsize=7.0, verticalalignment="center",
        )  # fmt: skip
        with replacing(path) as partial:
            figure.savefig(partial, format="pdf", metadata={"CreationDate": None, "Producer": None})


def _rectangles(black: Bools) -> list[tuple[int, int, int, int]]:
    """Rectangles (left, top, right, bottom) that cover the black cells: runs of a row, joined downwards."""
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(black.shape[0] + 1):
        cells = black[row] if row < black.shape[0] else np.zeros(black.shape[1], bool)
        changes = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]]).astype(np.int8)))
        runs = {(int(a), int(b)) for a, b in zip(changes[::2], changes[1::2], strict=True)}
        for run in [run for run in open_runs if run not in runs]:
            done.append((run[0], open_runs.pop(run), run[1], row))
        for run in runs:
            open_runs.setdefault(run, row)
    return sorted(done)


def write_coverage(path: Path, fit: Fit, views: Sequence[View], size: tuple[int, int]) -> None:
    """Write a picture of where corners were seen and how far off they are, and of each view's error.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    image, bars = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    px = np.concatenate([view.sighting.px for view in views])
    off = np.linalg.norm(np.concatenate(fit.errors_px), axis=1)
    dots = image.scatter(
        px[:, 0], px[:, 1], c=off, s=7, cmap="viridis", vmin=0.0, vmax=float(np.quantile(off, 0.98))
    )
    image.set(
        xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal",
        title=f"{len(px)} corners of {len(views)} views in the image of {size[0]}x{size[1]}",
    )  # fmt: skip
    figure.colorbar(dots, ax=image, label="distance from the model [px]")
    bars.bar(np.arange(len(views)), fit.view_rms_px, color="#4477aa")
    bars.axhline(fit.rms_px, color="black", linewidth=0.8)
    bars.set(title=f"RMS of each view [px], of all {fit.rms_px:.3f}", xlabel="view")
    write_png(figure, path)
