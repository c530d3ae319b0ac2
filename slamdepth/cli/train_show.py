# SPDX-License-Identifier: Apache-2.0
"""Terminal output of ``slamdepth train-depth``: progress bars, tables of plans and trials."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from slamdepth.cli.console import error_console

if TYPE_CHECKING:
    from rich.table import Table

    from slamdepth.training.plan import TrainingPlan
    from slamdepth.training.progress import Progress, TrainStep
    from slamdepth.training.search import SearchResult


@contextmanager
def training_bars(quiet: bool) -> Iterator[Progress]:
    """One bar per stage with epoch, loss and remaining time; none if quiet or not a terminal."""
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    err = error_console()
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[detail]}", markup=False),
    )
    with Progress(*columns, console=err, disable=quiet or not err.is_terminal) as bars:
        tasks: dict[str, TaskID] = {}

        def show(step: TrainStep) -> None:
            if step.stage not in tasks:
                tasks[step.stage] = bars.add_task(step.stage, total=step.total, detail=step.detail)
            bars.update(tasks[step.stage], completed=step.done, total=step.total, detail=step.detail)

        yield show


def plan_table(plan: TrainingPlan) -> Table:
    """Table of the samples and cache size of each source."""
    from rich.table import Table

    table = Table("places", "used for", title="features to compute", title_justify="left")
    for heading in ("images", "views", "cached", "on disk"):
        table.add_column(heading, justify="right")
    for source in plan.sources:
        use = "evaluation" if source.is_held_out else "training"
        numbers = (str(source.images), str(source.samples), str(source.cached), _size(source.size_bytes))
        table.add_row(", ".join(source.places), use, *numbers)
    return table


def plan_lines(plan: TrainingPlan) -> list[str]:
    """The lines printed below the table of a plan."""
    views = sum(source.samples for source in plan.sources)
    todo = views - sum(source.cached for source in plan.sources)
    lines = [
        f"{views} views, {todo} to compute; {_size(sum(source.size_bytes for source in plan.sources))} "
        f"on disk in {plan.sources[0].folder.parent}",
        f"{plan.steps} steps of training",
    ]
    if plan.features_s is not None and plan.training_s is not None:
        lines.append(
            f"estimated time, from one measured batch: features {_duration(plan.features_s)}, "
            f"training {_duration(plan.training_s)}"
        )
    else:
        lines.append(f"estimated time: unknown, {plan.missing}")
    for benchmark, places in plan.benchmarks.items():
        lines.append(f"the head will have seen {benchmark}: {', '.join(places)}")
    return lines


def trials_table(result: SearchResult) -> Table:
    """Table of all trials of a search, with the best one marked."""
    from rich.table import Table

    names = list(result.trials[0].settings)
    table = Table("trial", title="held-out AbsRel after median scaling per view", title_justify="left")
    for heading in (*names, "AbsRel"):
        table.add_column(heading, justify="right")
    for trial in result.trials:
        settings = (f"{trial.settings[name]:.4g}" for name in names)
        style = "bold green" if trial is result.best else None
        mark = " *" if trial is result.best else ""
        table.add_row(f"{trial.number}{mark}", *settings, f"{trial.score:.4f}", style=style)
    return table


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e9:.2f} GB" if size_bytes >= 1e8 else f"{size_bytes / 1e6:.1f} MB"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
