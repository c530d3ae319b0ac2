# SPDX-License-Identifier: Apache-2.0
"""``slamdepth view``: a run in the browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slamdepth.cli.console import (
    QuietOption,
    VerboseOption,
    console,
    error_console,
    print_notes,
    show_log,
)
from slamdepth.cli.options import HostOption, PortOption
from slamdepth.cli.signals import stop_on_signals

if TYPE_CHECKING:
    from slamdepth.pipeline.tracking import Watcher


def view_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of 'slamdepth run'.")],
    port: PortOption = 8080,
    host: HostOption = "127.0.0.1",
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Look at a run in the browser: mesh, cloud, keyframes with images, loops, several maps, playback.

    Example: slamdepth view runs/desk --port 8080

    Needs the extra 'viewer': pip install 'slamdepth[viewer]'. Ctrl-C ends it.
    """
    show_log()
    from slamdepth.report.saved_run import read_run
    from slamdepth.viewer import RunView, address_of, start_server, stop_server
    from slamdepth.viewer.run_view import wait_for_end

    saved = read_run(run)
    with stop_on_signals() as stop:
        server = start_server(host, port)
        try:
            shown = RunView(server, saved.with_meshes())
            out = console()
            out.print(f"viewer: {address_of(server)}   (Ctrl-C ends it)", markup=False, soft_wrap=True)
            if not quiet:
                print_notes(out, saved.notes)
            wait_for_end(stop)
            shown.close()
        finally:
            stop_server(server)


@contextmanager
def live_view(port: int | None) -> Iterator[Watcher | None]:
    """A viewer of a run that goes on, at this port; None where no viewer is wanted."""
    if port is None:
        yield None
        return
    from slamdepth.viewer import LiveView, address_of, start_server, stop_server

    server = start_server(port=port)
    try:
        error_console().print(f"viewer: {address_of(server)}", markup=False, soft_wrap=True)
        with LiveView(server) as view:
            yield view
    finally:
        stop_server(server)
