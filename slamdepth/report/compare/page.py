# SPDX-License-Identifier: Apache-2.0
"""Runs side by side, as a page and as a table for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamdepth.report.compare.comparison import Comparison, Row
from slamdepth.report.compare.plots import bars_plot, errors_plot, paths_plot
from slamdepth.report.page import render

if TYPE_CHECKING:
    from rich.table import Table


def build_compare_html(found: Comparison) -> str:
    """The page as one text: no scripts, nothing loaded from elsewhere."""
    summaries = [run.summary for run in found.runs]
    return render(
        "compare.html.j2",
        names=found.names,
        verdicts=[
            {"name": name, "verdict": summary["health"]["verdict"], "headline": summary["health"]["headline"]}
            for name, summary in zip(found.names, summaries, strict=True)
        ],
        sequences=sorted({str(summary["sequence"]) for summary in summaries}),
        figures=_cells(found.figures),
        differences=_cells(found.differences),
        charts={"paths": paths_plot(found), "errors": errors_plot(found), "bars": bars_plot(found)},
        has_truth=found.runs[0].scene.maps[0].truth is not None,
        notes=found.notes,
    )


def compare_table(found: Comparison) -> Table:
    """The figures and what differs, a column each run; the best of each row is bold."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_edge=False)
    table.add_column("")
    for name in found.names:
        table.add_column(Text(name), justify="right", overflow="fold")
    for rows in (found.figures, found.differences):
        for row in rows:
            cells = [Text(text, "bold" if n in row.best else "") for n, text in enumerate(row.shown)]
            table.add_row(Text(row.name), *cells)
        table.add_section()
        if rows is found.figures:
            table.add_row(Text("what differs" if found.differences else "no setting differs", "italic"))
    return table


def _cells(rows: tuple[Row, ...]) -> list[dict[str, object]]:
    return [
        {"name": row.name, "cells": [(text, n in row.best) for n, text in enumerate(row.shown)]}
        for row in rows
    ]
