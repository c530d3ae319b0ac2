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
