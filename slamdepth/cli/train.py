# SPDX-License-Identifier: Apache-2.0
"""``slamdepth train-depth``: depth heads made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log


def train_depth_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file that describes the training.")],
    device: Annotated[str, typer.Option(metavar="cpu|cuda", help="Where to train.")] = "cpu",
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a depth head on the DINOv2 backbone's features.

    Example: slamdepth train-depth slamdepth/depth/configs/dinov2_head.yaml

    A training that was killed goes on where it stopped, to the same result.
    """
    show_log()
    from rich.progress import Progress

    from slamdepth.depth.training.config import TrainConfig

    settings = TrainConfig.from_yaml(config)
    from slamdepth.depth.training.loop import train_depth

    err = error_console()
    with Progress(console=err, disable=quiet or not err.is_terminal) as bar:
        task = bar.add_task("starting", total=1.0)
        result = train_depth(
            settings,
            device=device,
            progress=lambda what, share: bar.update(task, completed=share, description=what),
        )
    out = console()
    out.print(f"head: {result.output}", markup=False)
    for place, figures in result.held_out.items():
        shown = ", ".join(f"{name} {value:.3f}" for name, value in figures.items())
        out.print(f"held out {place}: {shown}", markup=False)
