# SPDX-License-Identifier: Apache-2.0
"""``slamdepth calibrate``: a camera file from images of a board, and the board to print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import (
    QuietOption,
    VerboseOption,
    console,
    print_notes,
    print_places,
)
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import telling_what_is_kept

if TYPE_CHECKING:
    from rich.table import Table

    from slamdepth.boards.board import Board
    from slamdepth.pipeline.calibrate import CalibrationResult


def calibrate_command(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="VIDEO|FOLDER", help="Video, or folder of images, that shows the board."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="BOARD",
            help="charuco:COLUMNSxROWS[:FAMILY[:SHARE]] (squares), or checkerboard:COLUMNSxROWS (inner "
            "corners). Default: charuco:10x7, as --print makes it",
        ),
    ] = None,
    square_mm: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Side of a square. Distances only depend on it. Default: 25"),
    ] = None,
    fisheye: Annotated[
        bool, typer.Option("--fisheye", help="Wide lens: the Kannala-Brandt model instead of a pinhole.")
    ] = False,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE",
            help="Camera file; a folder with figures and a picture comes next to it.",
        ),
    ] = Path("camera.yaml"),
    print_to: Annotated[
        Path | None,
        typer.Option("--print", metavar="PDF", help="Write the board as a PDF to print, and end."),
    ] = None,
    paper: Annotated[str, typer.Option(metavar="a4|letter", help="Paper of --print.")] = "a4",
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Calibrate a camera: focal length, centre and distortion from a video of a printed board.

    Example: slamdepth calibrate --print board.pdf

    Example: slamdepth calibrate board.mp4 --output phone.yaml

    Example: slamdepth calibrate images --board checkerboard:9x6 --square-mm 30 --fisheye

    Glue the print on something flat. Film it for half a minute, held still now and then: near and far,
    tilted by 30 to 45 degrees to all sides, and in every corner of the image. 'slamdepth run VIDEO --camera
    phone.yaml' uses the file; zoom and resolution must be those of the calibration.
    """
    from slamdepth.boards.board import DEFAULT_BOARD, DEFAULT_SQUARE_MM, Board
    from slamdepth.errors import ConfigError
    from slamdepth.io import writable_file

    chosen = Board.parse(board or DEFAULT_BOARD, DEFAULT_SQUARE_MM if square_mm is None else square_mm)
    if print_to is not None:
        if source is not None:
            raise ConfigError("--print makes a board and reads no images: leave one of the two out")
        _print_board(writable_file(print_to, ".pdf"), chosen, paper, quiet)
        return
    if source is None:
        raise ConfigError("name a video or a folder of images, or make a board by --print board.pdf")
    output = writable_file(output, ".yaml")
    from slamdepth.pipeline.calibrate import calibrate, write_calibration

    with telling_what_is_kept(lambda: "nothing was written"), JobBar(quiet) as bar:
        result = calibrate(source, chosen, fisheye=fisheye, progress=bar.show)
        places = write_calibration(output, result)
    out = console()
    out.print(_table(result))
    print_notes(out, result.notes)
    if not quiet:
        print_places(out, places)


def _print_board(path: Path, board: Board, paper: str, quiet: bool) -> None:
    from slamdepth.report.board import write_board

    write_board(path, board, paper)
    if not quiet:
        console().print(
            f"{path}: board {board.name}, squares of {board.square_mm:g} mm; print at 100 %, check the line",
            markup=False, soft_wrap=True,
        )  # fmt: skip


def _table(result: CalibrationResult) -> Table:
    from rich.table import Table

    from slamdepth.boards.verdict import projection_sigma_px

    fit = result.fit
    table = Table(title=f"{fit.model.name}, {result.size[0]}x{result.size[1]} pixels")
    for heading in ("", "value", "deviation"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name, value, sigma in zip(fit.model.names, fit.values, fit.sigma, strict=True):
        digits = 2 if name in ("fx", "fy", "cx", "cy") else 5
        table.add_row(name, f"{value:.{digits}f}", f"{sigma:.{digits}f}")
    table.add_section()
    table.add_row("RMS (px)", f"{fit.rms_px:.3f}", "")
    table.add_row("unsure at the edge (px)", f"{projection_sigma_px(fit, result.size):.2f}", "")
    table.add_row(
        "views used / found / images", f"{len(result.views)} / {result.found} / {result.searched}", ""
    )
    return table
