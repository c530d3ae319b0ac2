# SPDX-License-Identifier: Apache-2.0
"""``slamdepth batch``: many recordings."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slamdepth.cli.console import (
    QuietOption,
    UsageProblem,
    VerboseOption,
    console,
    error_console,
    print_places,
)
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import Interrupted, stop_on_signals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from slamdepth.pipeline.batch import BatchProgress, Recording

_OURS = ("--output", "-o", "--overwrite")


def batch_command(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Recordings as for 'slamdepth run', patterns such as 'walks/*.mp4', or a .txt list: a "
            "recording a line, options of its run behind it.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="Folder of the batch: a run folder for each."),
    ],
    jobs: Annotated[
        int, typer.Option(min=1, metavar="N", help="Runs at a time; each has its share of the processors.")
    ] = 1,
    options: Annotated[
        str, typer.Option(metavar="TEXT", help="Options of every 'slamdepth run', as one text.")
    ] = "",
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on a Ray cluster (pip install 'slamdepth\\[ray]') that shares the folders: "
            "ray://HOST:10001, auto, or local.",
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run many recordings, each in a process of its own, and put them into one table.

    Example: slamdepth batch 'walks/*.mp4' --output runs/walks --jobs 2 --options "--camera phone.yaml"

    Example: slamdepth batch recordings.txt --output runs/all --options "--depth dinov2 --no-mesh"

    A recording that fails stops no other. The same command goes on where it stopped: finished runs are not
    repeated. Ctrl-C ends the runs in progress.
    """
    from slamdepth.pipeline.batch import find_recordings, run_batch
    from slamdepth.report.batch import batch_errors, batch_table

    recordings, common = find_recordings(inputs), _words(options)
    _check_options(recordings, common)
    with stop_on_signals() as stop, JobBar(quiet) as bar:
        content = run_batch(
            recordings,
            output,
            jobs=jobs,
            options=common,
            ray=ray,
            progress=lambda state: _show(bar, state),
            stop=stop,
        )
    out = console()
    out.print(batch_table(content))
    print_places(out, {"table": output / "batch.json", "page": output / "batch.html"})
    for line in batch_errors(content):
        error_console().print(f"failed: {line}", style="red", markup=False, soft_wrap=True)
    if stop.is_set():
        raise Interrupted("interrupted: finished runs are kept; the same command goes on")
    if content["counts"]["failed"]:
        raise typer.Exit(1)


def _words(options: str) -> tuple[str, ...]:
    from slamdepth.errors import ConfigError

    try:
        return tuple(shlex.split(options))
    except ValueError as error:
        raise ConfigError(f"--options: {error}") from error


def _check_options(recordings: Sequence[Recording], common: tuple[str, ...]) -> None:
    """Refuse options that 'slamdepth run' does not know, before anything runs.

    Raises:
        ConfigError: there is one, or one that is the batch's to give.
    """
    from slamdepth.errors import ConfigError

    for words in dict.fromkeys((*common, *one.options) for one in recordings):
        for word in words:
            if word.partition("=")[0] in _OURS:
                raise ConfigError(
                    f"{word} is given by the batch itself: leave it out of the options of a run"
                )
        try:
            _run_command().make_context("run", ["SEQ", *words])
        except typer.Exit as leaving:  # --help
            raise ConfigError("the options of a run must not ask for help") from leaving
        except UsageProblem as problem:
            raise ConfigError(f"options of a run: {problem.format_message()}") from problem


def _run_command() -> Any:
    from slamdepth.cli.run import run_command

    alone = typer.Typer(add_completion=False)
    alone.command("run")(run_command)
    return typer.main.get_command(alone)


def _show(bar: JobBar, state: BatchProgress) -> None:
    bar.show("running", state.ended, state.total, ", ".join(state.running))
