# SPDX-License-Identifier: Apache-2.0
"""``slamdepth weights``: list network weights, and download those that are absent."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, error_console, show_log

if TYPE_CHECKING:
    from slamdepth.depth.weights import Progress

app = typer.Typer(
    help="List and download network weights.\n\nExample: slamdepth weights pull", no_args_is_help=True
)


@app.command("list")
def list_command(verbose: VerboseOption = False, quiet: QuietOption = False) -> None:
    """Show every weights file: whether it is there, its size, licence and training data.

    Example: slamdepth weights list
    """
    show_log()
    from slamdepth.depth.hub_store import hub_entries
    from slamdepth.depth.weights import cache_dir, list_weights

    out = console()
    for entry in (*list_weights(), *hub_entries()):
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
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="Which weights, as 'weights list' names them, or hf:ORG/NAME[@REVISION] for any depth model "
            "of the hub. Default: the DINOv2 backbone",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Download again what is cached already.")] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Download weights into the cache folder and check their sha256.

    Example: slamdepth weights pull

    Example: slamdepth weights pull depth-anything-v2-small-metric-indoor

    Models of the hub need 'slamdepth[hub]'; HF_ENDPOINT, HF_TOKEN, HF_HUB_OFFLINE and proxies hold.

    Nothing is downloaded where the weights are cached; a download that broke off goes on where it stopped.
    """
    show_log()
    from slamdepth.depth.hub_models import BY_NAME
    from slamdepth.depth.hub_store import PREFIX
    from slamdepth.depth.weights import BACKBONE

    name = name or BACKBONE
    err = error_console()

    def report(what: str, share: float) -> None:
        if not quiet:
            err.print(f"{name}: {what}", markup=False)

    is_of_the_hub = name in BY_NAME or name.startswith(PREFIX)
    path = _from_the_hub(name, report, force, quiet) if is_of_the_hub else _other(name, report, force)
    if not quiet:
        console().print(f"{name}: {path}", markup=False)


def _from_the_hub(name: str, report: Progress, force: bool, quiet: bool) -> Path:
    from slamdepth.depth import hub_fetch
    from slamdepth.depth.hub_store import UNKNOWN, reference_of

    reference = reference_of(name)
    folder = hub_fetch.pull(reference, report, force=force, bar=not quiet)
    report(f"licence: {reference.known.licence if reference.known else UNKNOWN}", 1.0)
    return folder


def _other(name: str, report: Progress, force: bool) -> Path:
    from slamdepth.depth.hub_models import BY_NAME
    from slamdepth.depth.weights import BACKBONE, HEAD, pull_weights
    from slamdepth.errors import WeightsError

    if name not in (BACKBONE, HEAD):
        choices = ", ".join((BACKBONE, HEAD, *BY_NAME, "hf:ORG/NAME"))
        raise WeightsError(f"unknown weights '{name}'; choose from: {choices}")
    return pull_weights(name, report, force=force)
