# SPDX-License-Identifier: Apache-2.0
"""``slamdepth depth``: depth maps of an image, a folder or a video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, print_places
from slamdepth.cli.options import (
    CameraOption,
    DepthOption,
    DepthWeightsOption,
    DeviceOption,
    FollowLinksOption,
    MaxFramesOption,
    StrideOption,
)
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from slamdepth.pipeline.depth_maps import DepthMapResult


def depth_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IMAGE|FOLDER|VIDEO",
            help="An image, a folder of images, a video, or a TUM or 7-Scenes folder.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for the results. Default: depth/<name>"),
    ] = None,
    depth: DepthOption = "auto",
    depth_weights: DepthWeightsOption = None,
    camera: CameraOption = None,
    follow_links: FollowLinksOption = False,
    max_frames: MaxFramesOption = None,
    stride: StrideOption = 1,
    colour_range: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", metavar="NEAR FAR", help="Depth range of the colours, metres. Default: found"
        ),
    ] = None,
    no_cloud: Annotated[
        bool, typer.Option("--no-cloud", help="Write no point clouds, the largest files.")
    ] = False,
    device: DeviceOption = "cpu",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier depth maps in the output folder.")
    ] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write depth maps: colour, 16-bit millimetres, NumPy, point cloud; for a video also an mp4.

    Example: slamdepth depth holiday.mp4 --stride 5 --output holiday-depth

    Example: slamdepth depth room.jpg --depth hf:depth-anything/Depth-Anything-V2-Small-hf

    Metres need the focal length: --camera, a camera.yaml next to the images, a known sequence, or EXIF.

    Otherwise it is guessed, and the results say so.

    Ctrl-C keeps what is done; the same command goes on from there.
    """
    from slamdepth.datasets import ReadOptions
    from slamdepth.pipeline.depth_maps import DepthMapOptions, make_depth_maps

    options = DepthMapOptions(
        source=source,
        output=output,
        depth=depth,
        weights=depth_weights,
        camera_file=camera,
        stride=stride,
        max_frames=max_frames,
        colour_range=colour_range,
        cloud=not no_cloud,
        device=device,
        overwrite=overwrite,
        reading=ReadOptions(follow_links=follow_links),
    )
    with stop_on_signals() as stop, JobBar(quiet) as bar:
        result = make_depth_maps(options, progress=bar.show, stop=stop)
    _print_result(result, quiet)


def _print_result(result: DepthMapResult, quiet: bool) -> None:
    from slamdepth.pipeline.depth_maps.about import images
    from slamdepth.report.console import two_columns

    about = result.about
    rows = [
        ("images", str(about["frames"])),
        ("unit", about["unit"]),
        ("scale", about["scale"]),
        *(("intrinsics", f"{group['how']} ({images(group['images'])})") for group in about["intrinsics"][:3]),
    ]
    out = console()
    out.print(two_columns(f"{about['source']['name']} · depth: {about['model']['name']}", rows))
    print_places(out, {"results": result.folder})
    if not quiet:
        print_notes(out, about["notes"])
