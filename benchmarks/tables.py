# SPDX-License-Identifier: Apache-2.0
"""Tables of the SLAM benchmark: for a terminal, for a document, and changes since an earlier benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.markdown import markdown_table
from benchmarks.record import machine_line
from benchmarks.summary import METRICS, Metric

if TYPE_CHECKING:
    from rich.table import Table

MISSING = "-"
_NOISE = 0.02  # relative changes below this are not marked


def cell(metric: Metric, row: Mapping[str, Any]) -> str:
    """The median and, where runs differ, half of the range between the extremes."""
    value = row["figures"].get(metric.key)
    if value is None:
        return MISSING
    text = f"{value * metric.factor:.{metric.digits}f}"
    low, high = row["spread"].get(metric.key, (value, value))
    half = (high - low) / 2 * metric.factor
    return f"{text} ±{half:.{metric.digits}f}" if round(half, metric.digits) > 0 else text


def by_sequence(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """The rows of each sequence, in their order."""
    grouped: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        grouped.setdefault(row["sequence"], []).append(row)
    return grouped


def rich_tables(benchmark: Mapping[str, Any]) -> list[Table]:
    """A table for each sequence, with the machine above it and the notes below, for a terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    tables = []
    machine = machine_line(benchmark["environment"])
    for sequence, rows in by_sequence(benchmark["rows"]).items():
        notes = [f"{_name(row)}: {note}" for row in rows for note in row["notes"]]
        table = Table(
            title=Text.assemble((sequence, "bold"), "\n", (machine, "dim")),
            title_justify="left",
            box=box.SIMPLE,
            caption=Text("\n".join(notes)),
            caption_justify="left",
        )
        headings, lines = _headings_and_lines(rows)
        for number, heading in enumerate(headings):
            table.add_column(heading, no_wrap=number == 0, justify="left" if number < 2 else "right")
        for line in lines:
            table.add_row(*(Text(value) for value in line))
        tables.append(table)
    return tables


def markdown(benchmark: Mapping[str, Any]) -> str:
    """The machine, and a table for each sequence, for ``docs/benchmarks.md``."""
    parts = [f"{machine_line(benchmark['environment'])}."]
    parts += [
        f"### {sequence}\n\n{markdown_table(*_headings_and_lines(rows))}"
        for sequence, rows in by_sequence(benchmark["rows"]).items()
    ]
    return "\n\n".join(parts) + "\n"


def _headings_and_lines(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """The columns that any row has a figure for, and the cells of each row."""
    shown = [metric for metric in METRICS if any(metric.key in row["figures"] for row in rows)]
    lines = []
    for row in rows:
        label = row["label"] if row["status"] == "ok" else f"{row['label']}: {_trouble(row)}"
        lines.append([label, row["depth"], *(cell(metric, row) for metric in shown)])
    return ["system", "depth", *(metric.heading for metric in shown)], lines


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[tuple[str, str, str, float, float, int]]:
    """What moved between two benchmarks.

    Returns:
        Sequence, row, key, old and new median of every row and figure that both have, and 1 for better,
        -1 for worse, 0 for neither and for changes within 2 %.
    """
    before = {_key(row): row for row in old["rows"]}
    found = []
    for row in new["rows"]:
        earlier = before.get(_key(row))
        for metric in METRICS:
            if earlier is None or metric.key not in earlier["figures"] or metric.key not in row["figures"]:
                continue
            was, now = float(earlier["figures"][metric.key]), float(row["figures"][metric.key])
            moved = abs(now - was) > _NOISE * max(abs(was), 1e-12)
            verdict = metric.better * (1 if now > was else -1) if moved else 0
            found.append((row["sequence"], _name(row), metric.key, was, now, verdict))
    return found


def comparison_table(old: Mapping[str, Any], new: Mapping[str, Any]) -> Table:
    """Old and new medians, with a warning where machine or settings differ."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    metrics = {metric.key: metric for metric in METRICS}
    commit = str(old["environment"]["versions"].get("commit"))[:10]
    old_machine, new_machine = (one["environment"]["hardware"] for one in (old, new))
    known = old_machine.keys() & new_machine.keys()
    differing = [
        name
        for name, differs in (
            ("hardware", any(old_machine[key] != new_machine[key] for key in known)),
            ("settings", old["settings"] != new["settings"]),
        )
        if differs
    ]
    warning = f"not the same {' and '.join(differing)} as then" if differing else ""
    title = Text(f"change against {commit}", style="bold")
    table = Table(title=title, title_justify="left", box=box.SIMPLE, caption=warning, caption_justify="left")
    for name in ("sequence", "system", "figure"):
        table.add_column(name)
    for name in ("then", "now", "change"):
        table.add_column(name, justify="right")
    for sequence, name, key, was, now, verdict in changes(old, new):
        metric = metrics[key]
        change = f"{100 * (now - was) / was:+.0f} %" if was else MISSING
        style = {1: "green", -1: "red", 0: ""}[verdict]
        shown = [f"{value * metric.factor:.{metric.digits}f}" for value in (was, now)]
        table.add_row(sequence, Text(name), metric.heading, *shown, Text(change, style=style))
    return table


def _key(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["sequence"], row["label"], row["depth"]


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['label']} [{row['depth']}]"


def _trouble(row: Mapping[str, Any]) -> str:
    message = str(row["message"])
    return message if message.startswith(str(row["status"])) else f"{row['status']}: {message}"
