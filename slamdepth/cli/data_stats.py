# SPDX-License-Identifier: Apache-2.0
"""``slamdepth data-stats``: data sets with depth side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes
from slamdepth.cli.options import StrideOption
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import stop_on_signals


def data_stats_command(
    data: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATA",
            help="Sequences with sensor depth, training pairs or Hypersim scenes, or a folder of several.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Also write a page, a plot and JSON here."),
    ] = None,
    stride: StrideOption = 1,
    max_frames: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Look at no more than N images of each.")
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compare depth data: histograms, sparsity, ranges, number and size of images, focal length.

    Example: slamdepth data-stats depth_training rgbd_dataset_freiburg1_rpy --output data-stats
    """
    from slamdepth.pipeline.data_stats import data_statistics
    from slamdepth.report.data_stats import HISTOGRAMS, PAGE, data_tables

    with stop_on_signals() as stop, JobBar(quiet) as bar:
        about = data_statistics(
            data, output=output, stride=stride, max_frames=max_frames, progress=bar.show, stop=stop
        )
    out = console()
    for table in data_tables(about):
        out.print(table)
    if not quiet:
        for one in about["sets"]:
            print_notes(out, [f"{one['name']}: {note}" for note in one["notes"]])
        if output is not None:
            for name in (PAGE, HISTOGRAMS, "data-stats.json"):
                out.print(str(output / name), markup=False, soft_wrap=True)
