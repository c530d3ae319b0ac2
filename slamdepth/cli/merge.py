# SPDX-License-Identifier: Apache-2.0
"""``slamdepth merge``: maps of several runs joined into one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import (
    QuietOption,
    VerboseOption,
    console,
    error_console,
    print_notes,
    print_places,
)


def merge_command(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders with a map, or maps themselves.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the joined map.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier map in DIR.")] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Join the maps of several runs by places that they have in common.

    Example: slamdepth merge runs/kitchen runs/hall --output runs/flat

    The first run gives the world frame and the scale. Maps that never meet stay apart, and the table says so.
    """
    from slamdepth.pipeline.merge import merge, plan_folder

    folder = plan_folder(output, overwrite=overwrite)
    if not quiet:
        error_console().print(f"joining {len(runs)} maps", markup=False)
    result = merge(runs)
    result.save(folder)
    out = console()
    figures = result.figures()
    rows = {
        "recordings": ", ".join(f"{one['name']} ({one['frames']} frames)" for one in figures["sessions"]),
        "keyframes": figures["keyframes"],
        "landmarks": figures["points"],
        "joined by": f"{figures['meetings']} keyframes that see a place of another map",
    }
    width = max(map(len, rows))
    for name, value in rows.items():
        out.print(f"  {name:<{width}}   {value}", markup=False, soft_wrap=True)
    print_places(out, {"map": folder / "map", "trajectories": folder / "sessions"})
    if not quiet:
        print_notes(out, (f"{runs[n]}: never met the others and was left out" for n in result.apart))
