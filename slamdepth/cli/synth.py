# SPDX-License-Identifier: Apache-2.0
"""``slamdepth synth``: render a sequence with exact depth and poses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log
from slamdepth.cli.signals import telling_what_is_kept


def synth_command(
    output: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the sequence.")],
    frames: Annotated[int | None, typer.Option(metavar="N", help="Frames. Default: 300")] = None,
    fps: Annotated[float | None, typer.Option(metavar="HZ", help="Frame rate. Default: 30")] = None,
    width: Annotated[int | None, typer.Option(metavar="PX", help="Image width. Default: 640")] = None,
    height: Annotated[int | None, typer.Option(metavar="PX", help="Image height. Default: 480")] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            metavar="room|aliased", help="A room, or a hall of identical workstations. Default: room"
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Layout, colours, path. Default: 0")] = None,
    texture: Annotated[
        str | None, typer.Option(metavar="rich|low|bare", help="Amount of texture. Default: rich")
    ] = None,
    lighting_variation: Annotated[
        float | None, typer.Option(metavar="SHARE", help="Swing of exposure and tint. Default: 0.05")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(metavar="GREY", help="Deviation of the image noise. Default: 1")
    ] = None,
    motion_blur: Annotated[
        int | None, typer.Option(metavar="N", help="Exposures averaged per frame; 1 = no blur. Default: 1")
    ] = None,
    depth_noise: Annotated[
        float | None,
        typer.Option(metavar="M", help="Depth noise at 1 m, growing with the square. Default: 0"),
    ] = None,
    marker: Annotated[
        str | None,
        typer.Option(
            metavar="FAMILY:SIDE",
            help="Hang an AprilTag or ArUco marker on a wall of the room, its black square SIDE metres wide: "
            "tag36h11:0.16.",
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Render a furnished room, or a hall where places look alike, along a looping path, in TUM layout.

    Example: slamdepth synth demo/room --frames 300 --seed 1

    Example: slamdepth synth demo/office --scene aliased --frames 600 --seed 1

    The same options give the same files. An interrupted rendering resumes where it stopped.
    """
    show_log()
    from rich.progress import Progress

    from slamdepth.synth.sequence import SynthSettings, render_sequence

    asked = {
        "frames": frames, "fps": fps, "width": width, "height": height, "scene": scene, "seed": seed,
        "texture": texture, "lighting_variation": lighting_variation, "noise": noise,
        "motion_blur": motion_blur, "depth_noise": depth_noise, "marker": marker,
    }  # fmt: skip
    settings = SynthSettings.from_dict(
        {name: value for name, value in asked.items() if value is not None}, origin="command line"
    )
    done = 0
    err = error_console()

    def kept() -> str:
        if done == 0:
            return "no frame was rendered"
        return f"{done} of {settings.frames} frames are kept in {output}; the same command goes on"

    with (
        telling_what_is_kept(kept),
        Progress(console=err, transient=True, disable=quiet or not err.is_terminal) as bar,
    ):
        task = bar.add_task("rendering", total=settings.frames)

        def show(frames_done: int, total: int) -> None:
            nonlocal done
            done = frames_done
            bar.update(task, completed=done)

        folder = render_sequence(output, settings, show)
    if not quiet:
        console().print(f"{settings.frames} frames in {folder}", markup=False, soft_wrap=True)
