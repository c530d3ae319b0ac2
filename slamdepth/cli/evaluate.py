# SPDX-License-Identifier: Apache-2.0
"""``slamdepth evaluate``: the score of a trajectory file against another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, show_log


def evaluate_command(
    ground_truth: Annotated[
        Path, typer.Argument(metavar="GROUNDTRUTH", help="Trajectory file: TUM, or EuRoC with its header.")
    ],
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="Trajectory file of the same kinds.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write the figures here, as JSON."),
    ] = None,
    max_difference: Annotated[
        float | None,
        typer.Option(metavar="S", help="Poses farther apart in time are not compared. Default: 0.01"),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Poses per second, for RPE. Default: from the times of the estimate"),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compare two trajectory files: ATE and RPE, equal to those of evo's own commands.

    Times in milliseconds, microseconds or nanoseconds are converted, with a note.

    Example: slamdepth evaluate desk/groundtruth.txt runs/desk/trajectory.txt --output score.json
    """
    show_log()
    from slamdepth.errors import ConfigError, DatasetError
    from slamdepth.evaluation import MAX_DIFFERENCE_S, score_trajectory
    from slamdepth.io import read_trajectory_pair, writable_file, write_json
    from slamdepth.report import trajectory_table

    for name, value in (("--max-difference", max_difference), ("--fps", fps)):
        if value is not None and not 0 < value < float("inf"):
            raise ConfigError(f"{name} must be positive and finite, got {value:g}")
    if output is not None:
        output = writable_file(output, ".json")
    (truth, truth_notes), (estimated, estimate_notes) = read_trajectory_pair(ground_truth, estimate)
    notes = [*truth_notes, *estimate_notes]
    try:
        score = score_trajectory(
            truth,
            estimated,
            max_difference_s=MAX_DIFFERENCE_S if max_difference is None else max_difference,
            fps=fps,
        )
    except DatasetError as error:
        raise DatasetError("; ".join([str(error), *notes])) from error
    figures = score.to_dict()
    if output is not None:
        write_json(output, {**figures, "notes": notes})
    out = console()
    out.print(trajectory_table(figures, f"{estimate.name} against {ground_truth.name}"))
    if not quiet:
        print_notes(out, notes)
        if output is not None:
            out.print(f"figures: {output}", markup=False)
