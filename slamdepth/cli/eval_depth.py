# SPDX-License-Identifier: Apache-2.0
"""``slamdepth eval-depth``: evaluate a depth model against sensor depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log
from slamdepth.cli.options import CameraOption, DepthWeightsOption, DeviceOption, FollowLinksOption
from slamdepth.cli.signals import Interrupted, telling_what_is_kept

if TYPE_CHECKING:
    from slamdepth.depth.base import DepthModel
    from slamdepth.evaluation import DepthJudgement
    from slamdepth.report.depth import SheetRow
    from slamdepth.training.data import Place

_SHEET_FRAMES = 4


def eval_depth_command(
    model: Annotated[
        str, typer.Argument(metavar="MODEL", help="Depth model; an unknown name lists the known ones.")
    ],
    data: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATA",
            help="Sequences with sensor depth, training pairs or Hypersim scenes, or a folder of several.",
        ),
    ],
    depth_weights: DepthWeightsOption = None,
    camera: CameraOption = None,
    follow_links: FollowLinksOption = False,
    stride: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Evaluate every Nth frame. Default: 10; 1 for training pairs"),
    ] = None,
    max_frames: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Evaluate at most N frames of each DATA.")
    ] = None,
    device: DeviceOption = "cpu",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write all figures here, as JSON, with images next to it."
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Evaluate predicted depth against a depth sensor: as predicted, and scaled in three ways.

    Example: slamdepth eval-depth dinov2 rgbd_dataset_freiburg1_rpy --stride 20 --output rpy.json
    """
    show_log()
    from slamdepth.datasets import ReadOptions
    from slamdepth.depth.hub_store import is_hub_name
    from slamdepth.depth.registry import create_depth_model
    from slamdepth.errors import ConfigError, SlamdepthError
    from slamdepth.evaluation import Interval, mean_over_sets
    from slamdepth.io import writable_file
    from slamdepth.pipeline.depth_data import open_depth_data, thinned
    from slamdepth.report.depth import judgement_lines, judgement_table, model_lines

    if Path(model).is_dir() and not is_hub_name(model):
        raise ConfigError(
            f"{model}: is a folder, where a depth model's name is expected; the order is "
            "'slamdepth eval-depth MODEL DATA...'"
        )
    if output is not None:
        output = writable_file(output, ".json")
    reading = ReadOptions(follow_links=follow_links)
    places = [place for path in data for place in open_depth_data(path, camera=camera, reading=reading)]
    network = create_depth_model(model, device=device, weights=depth_weights)
    out = console()
    for line in model_lines(network):
        out.print(line, markup=False, soft_wrap=True)
    judged: dict[str, DepthJudgement] = {}
    settings = {"stride": stride, "max_frames": max_frames, "device": device}
    written: list[str] = []
    images: dict[str, None] = {}

    def kept() -> str:
        if not written:
            return "nothing was written"
        return f"{output} has the {len(written)} of {len(places)} data sets evaluated so far"

    try:
        with telling_what_is_kept(kept):
            for number, place in enumerate(places, 1):
                name = place.name if place.name not in judged else f"{place.name}-{number}"
                judged[name], sheet = _judge(network, place, thinned(place, stride, max_frames), quiet)
                if output is not None:
                    left = [one.name for one in places[number:]]
                    _write_figures(output, network, settings, judged, left)
                    written.append(name)
                    images |= dict.fromkeys(_draw(output, network, name, judged, sheet))
                out.print(
                    judgement_table(judged[name].ways, f"{network.name} ({network.kind.value}) on {name}")
                )
                for line in judgement_lines(judged[name]):
                    out.print(line, markup=False)
    except SlamdepthError as error:
        if written and not isinstance(error, Interrupted):
            out.print(f"figures: {kept()}", markup=False, soft_wrap=True)
        raise
    if len(judged) > 1:
        mean = mean_over_sets(list(judged.values()))
        shown = {way: {name: Interval(v) for name, v in figures.items()} for way, figures in mean.items()}
        out.print(judgement_table(shown, f"mean over the {len(judged)} data sets, equally weighted"))
    if output is not None:
        out.print(f"figures: {output}, images: {', '.join(images)}", markup=False, soft_wrap=True)


def _judge(
    model: DepthModel, place: Place, indices: Sequence[int], quiet: bool
) -> tuple[DepthJudgement, list[SheetRow]]:
    """Evaluate one data set, and keep a few of its frames for the contact sheet."""
    from rich.progress import track

    from slamdepth.depth.evaluate import judge_depth
    from slamdepth.pipeline.depth_data import readable, shown
    from slamdepth.report.depth import SheetRow
    from slamdepth.types import DepthPrediction, Frame

    wanted = shown(indices, _SHEET_FRAMES)
    rows: list[SheetRow] = []

    def watch(frame: Frame, prediction: DepthPrediction) -> None:
        from slamdepth.evaluation.depth_fit import fitted_to_sensor

        if frame.index in wanted and frame.depth_m is not None:
            fitted = fitted_to_sensor(prediction.values, prediction.kind, frame.depth_m)
            rows.append(SheetRow(frame.image_rgb, frame.depth_m, fitted))

    err = error_console()
    frames = track(
        readable(place, indices), f"evaluating {place.name}", total=len(indices), console=err, transient=True,
        disable=quiet or not err.is_terminal,
    )  # fmt: skip
    return judge_depth(model, frames, watch=watch), rows


def _write_figures(
    output: Path,
    model: DepthModel,
    settings: Mapping[str, object],
    judged: Mapping[str, DepthJudgement],
    left: Sequence[str],
) -> None:
    """Write the JSON file of the data sets evaluated so far; it names those that are ``left``."""
    from dataclasses import asdict

    from slamdepth.depth.card import card_of
    from slamdepth.evaluation import mean_over_sets
    from slamdepth.io import write_json
    from slamdepth.report.environment import hardware, versions

    write_json(
        output,
        {
            "complete": not left,
            "not_judged": list(left),
            "depth_model": model.name,
            "kind": model.kind,
            "card": None if (card := card_of(model)) is None else asdict(card),
            "weights": [asdict(info) for info in model.weights],
            "settings": settings,
            "versions": versions(),
            "hardware": hardware(),
            "mean_over_sets": mean_over_sets(list(judged.values())),
            "data": {name: judgement.to_dict() for name, judgement in judged.items()},
        },
    )


def _draw(
    output: Path,
    model: DepthModel,
    name: str,
    judged: Mapping[str, DepthJudgement],
    sheet: Sequence[SheetRow],
) -> list[str]:
    """Draw plots of all data sets so far and a contact sheet of ``name``, next to the JSON file.

    Returns:
        The names of the image files.
    """
    from slamdepth.report.depth import write_over_depth, write_sheet
    from slamdepth.report.depth_calibration import write_calibration
    from slamdepth.types import DepthKind

    images = [output.with_name(f"{output.stem}_over_depth.png")]
    write_over_depth(images[0], judged, model.name)
    calibration = output.with_name(f"{output.stem}_calibration.png")
    if write_calibration(calibration, judged, model.name):
        images.append(calibration)
    if sheet:
        scaled = f"after each frame's {'median' if model.kind is DepthKind.METRIC else 'affine fit'}"
        images.append(output.with_name(f"{output.stem}_{name}.png"))
        write_sheet(images[-1], sheet, scaled, f"{model.name} on {name}")
    return [image.name for image in images]
