# SPDX-License-Identifier: Apache-2.0
"""``slamdepth train-depth``: train a depth head."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, show_log
from slamdepth.cli.options import DeviceOption


def train_depth_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file that describes the training.")],
    device: DeviceOption = "cpu",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show samples, disk space and time; train nothing.")
    ] = False,
    search: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Tune the settings under 'search' until N trials are done; then stop."
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a depth head on the DINOv2 backbone's features.

    Example: slamdepth train-depth slamdepth/training/configs/dinov2_head.yaml --dry-run

    A training or search that was killed resumes where it stopped and gives the same result.

    Relative data folders are looked up below $SLAMDEPTH_DATA.

    Loss curves, sample predictions and figures are written to a folder next to the head.
    """
    show_log()
    from slamdepth.cli.train_show import plan_lines, plan_table, training_bars, trials_table
    from slamdepth.io import writable
    from slamdepth.pipeline.training import plan_run, report_folder, run_search, run_training
    from slamdepth.training.config import TrainConfig
    from slamdepth.training.output import check_output

    settings = TrainConfig.from_yaml(config)
    writable(report_folder(check_output(settings)))
    out = console()
    if dry_run:
        plan = plan_run(settings, device=device)
        out.print(plan_table(plan))
        for line in plan_lines(plan):
            out.print(line, markup=False, soft_wrap=True)
        return
    if search is not None:
        with training_bars(quiet) as progress:
            found = run_search(settings, search, device=device, progress=progress)
        out.print(trials_table(found))
        out.print(f"best settings: {found.best_config}", markup=False, soft_wrap=True)
        out.print(f"study: {found.study}", markup=False, soft_wrap=True)
        return
    with training_bars(quiet) as progress:
        result = run_training(settings, device=device, progress=progress)
    out.print(f"head: {result.output}", markup=False, soft_wrap=True)
    out.print(f"curves and samples: {report_folder(result.output)}", markup=False, soft_wrap=True)
    for place, ratios in result.unseen_surest_half.items():
        shown = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
        out.print(f"surest half in {place}, left out: {shown}", markup=False)
    for place, figures in result.held_out.items():
        shown = ", ".join(f"{name} {value:.3f}" for name, value in figures.items())
        out.print(f"held out {place}: {shown}", markup=False)
