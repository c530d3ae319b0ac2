# SPDX-License-Identifier: Apache-2.0
"""``slamdepth scale``: one scale of predicted depth for a sequence, from its depth sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log
from slamdepth.cli.options import (
    CameraOption,
    DepthOption,
    DepthWeightsOption,
    DeviceOption,
    FollowLinksOption,
    MaxFramesOption,
    StrideOption,
)
from slamdepth.cli.signals import telling_what_is_kept


def scale_command(
    sequence: Annotated[
        Path, typer.Argument(metavar="SEQ", help="Folder of a sequence that has sensor depth.")
    ],
    depth: DepthOption = "auto",
    depth_weights: DepthWeightsOption = None,
    shift: Annotated[
        bool,
        typer.Option(
            "--shift",
            help="Fit a shift too: in metres, or in 1/m for models that predict inverse depth.",
        ),
    ] = False,
    camera: CameraOption = None,
    follow_links: FollowLinksOption = False,
    stride: StrideOption = 10,
    max_frames: MaxFramesOption = None,
    device: DeviceOption = "cpu",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write the scale here, as YAML for --depth-scale."
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Fit one scale of predicted depth to a sequence's depth sensor, robustly.

    Example: slamdepth scale rgbd_dataset_freiburg1_rpy --output rpy-scale.yaml

    Then 'slamdepth run SEQ --depth-scale rpy-scale.yaml' multiplies every prediction by it.
    """
    show_log()
    from rich.progress import Progress

    from slamdepth.datasets import ReadOptions, open_dataset
    from slamdepth.datasets.intrinsics import tell_guess
    from slamdepth.datasets.sensor_depth import lack_of_depth
    from slamdepth.depth.registry import create_depth_model
    from slamdepth.depth.scale import check_can_fit, fit_scale
    from slamdepth.depth.scale_file import write_scale
    from slamdepth.errors import DatasetError
    from slamdepth.io import writable_file
    from slamdepth.pipeline.prediction_scale import read_with_depth
    from slamdepth.pipeline.sequence_id import sequence_id
    from slamdepth.report import scale_table

    dataset = open_dataset(sequence, camera, ReadOptions(follow_links=follow_links))
    if not dataset.has_depth:
        raise DatasetError(
            f"{sequence}: {lack_of_depth(dataset)}, so no scale can be fitted; 'slamdepth run SEQ "
            "--depth-scale groundtruth' can take a scale from a ground truth trajectory"
        )
    tell_guess(dataset.name, dataset.camera_source)
    if output is not None:
        output = writable_file(output, ".yaml")
    model = create_depth_model(depth, device=device, weights=depth_weights)
    check_can_fit(model, shift)
    err = error_console()
    with (
        telling_what_is_kept(lambda: "nothing was written"),
        Progress(console=err, transient=True, disable=quiet or not err.is_terminal) as bar,
    ):
        task = bar.add_task("fitting the scale")
        frames = read_with_depth(
            dataset,
            range(0, len(dataset), stride)[:max_frames],
            lambda done, total: bar.update(task, completed=done, total=total),
        )
        fit = fit_scale(
            model, frames, with_shift=shift, sequence=dataset.name, sequence_id=sequence_id(dataset)
        )
    out = console()
    out.print(scale_table(fit))
    if output is not None:
        write_scale(output, fit)
    if not quiet:
        kept = f"scale: {output}" if output is not None else "not written: add --output FILE"
        out.print(
            f"{kept}; apply it with 'slamdepth run SEQ --depth-scale FILE'", markup=False, soft_wrap=True
        )
