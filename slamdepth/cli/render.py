# SPDX-License-Identifier: Apache-2.0
"""``slamdepth render``: a video of the reconstruction."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_places
from slamdepth.cli.progress import JobBar


def render_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of 'slamdepth run', with a mesh.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The mp4 file. Default: flight.mp4 in the folder"
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(metavar="S", help="Length of the video.")] = 12.0,
    fps: Annotated[float, typer.Option(metavar="HZ", help="Images per second.")] = 24.0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size in pixels.")] = "960x540",
    number: Annotated[
        int, typer.Option("--map", metavar="N", help="Which of several maps, 1 for the largest.")
    ] = 1,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make a video of the reconstruction: a flight along the camera's path through the mesh.

    Example: slamdepth render runs/desk --seconds 20 --size 1280x720
    """
    from slamdepth.errors import ConfigError
    from slamdepth.io import writable_file
    from slamdepth.pipeline.flight import FLIGHT_FILE, FlightQuestion, render_flight
    from slamdepth.report.saved_run import read_run

    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if sides is None:
        raise ConfigError(f"--size must be WIDTHxHEIGHT such as 960x540, got '{size}'")
    place = run / FLIGHT_FILE if output is None else output
    if output is None:
        read_run(run)  # a folder that is no run is said first
    place = writable_file(place, ".mp4")
    if place.suffix.lower() != ".mp4":
        raise ConfigError(f"{place}: the video must end in .mp4")
    asked = FlightQuestion(run, place, seconds, fps, int(sides[1]), int(sides[2]), number)
    with JobBar(quiet) as bar:
        render_flight(asked, lambda done, total: bar.show("rendering", done, total))
    print_places(console(), {"video": place})
