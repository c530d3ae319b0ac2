# SPDX-License-Identifier: Apache-2.0
"""``slamdepth compare``: runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, print_places, show_log


def compare_command(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN...", help="Folders of 'slamdepth run'.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="The page; the figures go next to it, as JSON of the same name. Default: compare.html",
            show_default=False,
        ),
    ] = Path("compare.html"),
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Put runs side by side: verdicts, errors, speed, meshes, paths over one another, settings that differ.

    Example: slamdepth compare runs/desk-fast runs/desk-best --output desk.html

    Paths are aligned to that of the first run.
    """
    show_log()
    from slamdepth.errors import OutputError
    from slamdepth.io import writable_file, write_json, write_text
    from slamdepth.report.compare import build_compare_html, compare_runs, compare_table
    from slamdepth.report.saved_run import read_run

    if output.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{output}: the page must end in .html")
    page = writable_file(output, output.suffix.lower())
    figures = writable_file(output.with_suffix(".json"), ".json")
    found = compare_runs([read_run(folder) for folder in runs])
    write_json(figures, found.to_dict())
    write_text(page, build_compare_html(found))
    out = console()
    out.print(compare_table(found))
    print_places(out, {"page": page, "figures": figures})
    if not quiet:
        print_notes(out, found.notes)
