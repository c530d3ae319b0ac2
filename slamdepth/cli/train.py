# SPDX-License-Identifier: Apache-2.0
"""``slamdepth train-depth`` and ``slamdepth eval-depth``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption


def train_depth_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file of a training.")],
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a depth head."""


def eval_depth_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file of a training.")],
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Judge a depth model."""
