# SPDX-License-Identifier: Apache-2.0
"""``slamdepth train-depth`` and ``slamdepth eval-depth``: depth heads made and judged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log

if TYPE_CHECKING:
    from slamdepth.datasets import Dataset
    from slamdepth.types import Frame


def train_depth_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file that describes the training.")],
    device: Annotated[str, typer.Option(metavar="cpu|cuda", help="Where to train.")] = "cpu",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Tell samples, disk space and time, and train nothing.")
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

    Example: slamdepth train-depth slamdepth/depth/configs/dinov2_head.yaml --dry-run

    A training or search that was killed goes on where it stopped, to the same result.

    Loss curves, sample predictions and figures go into a folder beside the head.
    """
    show_log()
    from slamdepth.cli.train_show import plan_lines, plan_table, training_bars, trials_table
    from slamdepth.depth.training.config import TrainConfig
    from slamdepth.pipeline.training import plan_run, report_folder, run_search, run_training

    settings = TrainConfig.from_yaml(config)
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
    for place, figures in result.held_out.items():
        shown = ", ".join(f"{name} {value:.3f}" for name, value in figures.items())
        out.print(f"held out {place}: {shown}", markup=False)


def eval_depth_command(
    sequence: Annotated[
        Path, typer.Argument(metavar="SEQ", help="Folder of a sequence that has sensor depth.")
    ],
    depth: Annotated[str, typer.Option(metavar="NAME", help="Depth model to judge.")] = "dinov2",
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="camera.yaml with the intrinsics in pixels.")
    ] = None,
    stride: Annotated[int, typer.Option(min=1, metavar="N", help="Judge every Nth frame.")] = 10,
    max_frames: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Judge no more than N frames.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="cpu|cuda", help="Where the network runs.")] = "cpu",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write the figures here, as JSON."),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Judge predicted depth against a depth sensor.

    Example: slamdepth eval-depth rgbd_dataset_freiburg1_rpy --stride 20
    """
    show_log()
    from slamdepth.datasets import open_dataset
    from slamdepth.depth.evaluate import judge_depth
    from slamdepth.depth.registry import create_depth_model
    from slamdepth.errors import DatasetError
    from slamdepth.io import write_json
    from slamdepth.report import depth_table

    dataset = open_dataset(sequence, camera)
    if not dataset.has_depth:
        raise DatasetError(f"{sequence}: has no sensor depth to judge a prediction by")
    model = create_depth_model(depth, device=device)
    judged = judge_depth(model, _frames(dataset, stride, max_frames, quiet))
    figures = judged.to_dict()
    if output is not None:
        weights = [{"name": info.name, "sha256": info.sha256} for info in model.weights]
        write_json(
            output, {"sequence": dataset.name, "depth_model": model.name, "weights": weights, **figures}
        )
    out = console()
    title = f"{model.name} on {dataset.name}: {judged.accuracy.frames} frames"
    out.print(depth_table(judged.accuracy.to_dict(), title))
    if judged.uncertainty is not None:
        out.print(
            f"errors within one sigma: {judged.uncertainty.within_one_sigma:.2f} (0.68 if calibrated); "
            f"AbsRel of the surest half over that of all: {judged.uncertainty.surest_half:.2f}"
        )


def _frames(dataset: Dataset, stride: int, max_frames: int | None, quiet: bool) -> Iterator[Frame]:
    """Every ``stride``-th frame with its depth; what does not decode is left out with a warning."""
    import logging

    from rich.progress import track

    from slamdepth.errors import ImageDecodeError

    indices = range(0, len(dataset), stride)[:max_frames]
    err = error_console()
    hidden = quiet or not err.is_terminal
    for index in track(indices, "judging", console=err, transient=True, disable=hidden):
        try:
            yield dataset.read(index, with_depth=True)
        except ImageDecodeError as error:
            logging.getLogger("slamdepth.cli").warning("frame left out: %s", error)
