# SPDX-License-Identifier: Apache-2.0
"""The table of a batch of runs: for ``batch.json``, a terminal and a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamdepth.io import write_text
from slamdepth.report.page import render
from slamdepth.report.text import MISSING, count, fixed, percent

if TYPE_CHECKING:
    from rich.table import Table

_HEADS = (
    "run",
    "state",
    "verdict",
    "frames",
    "tracked",
    "keyframes",
    "loops",
    "ATE Sim(3) (m)",
    "fps",
    "seconds",
)


def batch_row(report: dict[str, Any] | None) -> dict[str, Any]:
    """The figures of one run for ``batch.json``; unknown ones are None.

    Args:
        report: its ``report.json``; None where it has none.
    """
    report = report or {}
    health = report.get("health") or {}
    ate = ((report.get("ate") or {}).get("sim3") or {}).get("rmse_m")
    names = ("frames", "tracked_fraction", "keyframes", "loop_closures", "fps")
    return {
        "verdict": health.get("verdict"),
        "headline": health.get("headline"),
        **{name: report.get(name) for name in names},
        "maps": len(report.get("maps") or ()) or None,
        "scale": (report.get("scale") or {}).get("sentence"),
        "ate_sim3_m": ate,
    }


def batch_rows(content: dict[str, Any]) -> list[list[str]]:
    """The rows of :data:`_HEADS` of ``batch.json``."""
    return [
        [
            run["name"],
            run["state"],
            run["verdict"] or MISSING,
            count(run["frames"]),
            percent(run["tracked_fraction"]),
            count(run["keyframes"]),
            count(run["loop_closures"]),
            fixed(run["ate_sim3_m"], 3),
            fixed(run["fps"], 1),
            fixed(run["wall_s"], 0),
        ]
        for run in content["runs"]
    ]


def batch_errors(content: dict[str, Any]) -> list[str]:
    """A line for each run that failed or was stopped."""
    return [f"{run['name']}: {run['error']}" for run in content["runs"] if run["error"]]


def batch_table(content: dict[str, Any]) -> Table:
    """The table of a batch for a terminal."""
    from rich.table import Table

    table = Table(*_HEADS, box=None, pad_edge=False, title_justify="left")
    for column in table.columns[3:]:
        column.justify = "right"
    for row in batch_rows(content):
        table.add_row(*row)
    return table


def write_batch_page(path: Path, content: dict[str, Any]) -> None:
    """Write ``batch.html``; runs that are done link to their reports.

    Raises:
        OutputError: it cannot be written.
    """
    page = render(
        "batch.html.j2",
        counts=content["counts"],
        heads=_HEADS,
        rows=batch_rows(content),
        links={
            run["name"]: f"{run['name']}/report.html" for run in content["runs"] if run["state"] == "done"
        },
        scales=[(run["name"], run["scale"]) for run in content["runs"] if run["scale"]],
        errors=batch_errors(content),
    )
    write_text(path, page)
