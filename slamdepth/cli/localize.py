# SPDX-License-Identifier: Apache-2.0
"""``slamdepth localize``: where a recording, or one image, is in a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, print_places
from slamdepth.cli.options import (
    CameraOption,
    FollowLinksOption,
    MaxFramesOption,
    StrideOption,
    TopicOption,
)
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from slamdepth.pipeline.localize import Localisation


def localize_command(
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help="A video, a folder of images, a sequence, or one image.")
    ],
    map_: Annotated[
        Path, typer.Option("--map", metavar="RUN", help="Run folder whose map is used, or the map itself.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Results. Default: runs/<input>-localized-<time>"),
    ] = None,
    camera: CameraOption = None,
    max_frames: MaxFramesOption = None,
    stride: StrideOption = 1,
    topic: TopicOption = None,
    follow_links: FollowLinksOption = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace earlier results in DIR.")] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Find the pose of each frame in the map of an earlier run, which does not change.

    Example: slamdepth localize --map runs/kitchen walk.mp4 --output runs/walk-in-kitchen

    Example: slamdepth localize --map runs/kitchen photo.jpg

    A frame without a place, or with two that look alike, gets no pose.
    """
    from slamdepth.datasets import ReadOptions
    from slamdepth.mapstore import Map
    from slamdepth.pipeline.localize import localize, plan_folder

    saved = Map.load(map_)
    folder = plan_folder(output, source.stem or source.resolve().name, overwrite=overwrite)
    with stop_on_signals() as stop, JobBar(quiet) as bar:
        found = localize(
            saved,
            source,
            camera=camera,
            max_frames=max_frames,
            stride=stride,
            reading=ReadOptions(topic, follow_links=follow_links),
            progress=lambda done, total, step: bar.show("placing", done, total, step.status.value),
            stop=stop.is_set,
        )
    found.save(folder)
    _print(found, folder, quiet)


def _print(found: Localisation, folder: Path, quiet: bool) -> None:
    out = console()
    figures = found.figures()
    share = 100.0 * figures["placed"] / figures["frames"]
    rows = {
        "frames": str(figures["frames"]),
        "placed": f"{figures['placed']} ({share:.1f} %)",
        **{name: str(count) for name, count in figures["by_status"].items()},
    }
    if figures["median_quality"] is not None:
        rows["quality"] = f"{figures['median_quality']:.2f}, the median of the placed"
    rows["frames per second"] = f"{figures['frames_per_second']:.1f}"
    if len(found.steps) == 1 and (T := found.steps[0].T_world_camera) is not None:
        rows["position in the map"] = " ".join(f"{value:.3f}" for value in T[:3, 3]) + " m"
    width = max(map(len, rows))
    for name, value in rows.items():
        out.print(f"  {name:<{width}}   {value}", markup=False, soft_wrap=True)
    places = {name.split(".")[0]: folder / name for name in ("trajectory.txt", "frames.csv")}
    print_places(out, places)
    if not quiet:
        print_notes(out, found.notes)
