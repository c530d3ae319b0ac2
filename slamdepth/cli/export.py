# SPDX-License-Identifier: Apache-2.0
"""``slamdepth export``: a finished run as files of other tools."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console
from slamdepth.cli.options import CameraOption, export_names
from slamdepth.cli.progress import JobBar


def export_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run of 'slamdepth run'.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="NAME[,NAME]",
            help="colmap, nerfstudio, rerun (with images); tum, kitti, euroc (trajectories); ply, obj, glb "
            "(meshes).",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder to write. Default: RUN/export/NAME"),
    ] = None,
    images: Annotated[
        str,
        typer.Option(
            metavar="undistorted|raw|none",
            help="Images of a pinhole camera with a global shutter, images as they were taken (of a wide "
            "lens: the pinhole views that were tracked), or none.",
        ),
    ] = "undistorted",
    every_frame: Annotated[
        bool, typer.Option("--every-frame", help="Export every frame that has a pose, not only keyframes.")
    ] = False,
    map_number: Annotated[
        int, typer.Option("--map", metavar="N", help="Which map of the run; 1 is the largest.")
    ] = 1,
    recording: Annotated[
        Path | None,
        typer.Option(metavar="SEQ", help="What was run, for its images. Default: as the run says"),
    ] = None,
    camera: CameraOption = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier export in the folder.")
    ] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Export a finished run to COLMAP, nerfstudio, evo, a mesh viewer or Rerun.

    Example: slamdepth export runs/desk --to nerfstudio,glb

    Example: slamdepth export runs/desk --to colmap --images raw --output desk-colmap

    Each export has a README.txt: frame, unit, scale, and a command to go on with. A format that fails stops
    no other; the last line names it.
    """
    from slamdepth.errors import ConfigError, InputError, SlamdepthError
    from slamdepth.pipeline.export import check_exports, export_run

    names = export_names(to)
    check_exports(names)
    if not names:
        raise ConfigError("--to names no format; see 'slamdepth export --help'")
    folders: list[Path] = []
    errors: dict[str, SlamdepthError] = {}
    with JobBar(quiet) as bar:
        for name in names:
            try:
                folder = export_run(
                    run,
                    name,
                    output if output is None or len(names) == 1 else output / name,
                    images=images,
                    every_frame=every_frame,
                    map_number=map_number,
                    recording=recording,
                    camera=camera,
                    overwrite=overwrite,
                    progress=partial(bar.show, name),
                )
            except SlamdepthError as error:
                errors[name] = error
            else:
                folders.append(folder)
    out = console()
    for folder in folders:
        out.print(f"{folder}", markup=False, soft_wrap=True)
    if not errors:
        return
    first = next(iter(errors.values()))
    if not folders and len({str(error) for error in errors.values()}) == 1:
        raise first
    is_input = any(error.exit_code == InputError.exit_code for error in errors.values())
    kind = InputError if is_input else SlamdepthError
    raise kind("; ".join(f"not exported to {name}: {error}" for name, error in errors.items()))
