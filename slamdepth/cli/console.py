# SPDX-License-Identifier: Apache-2.0
"""What all commands share: verbosity, and where they write."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

_UNBROKEN = 4096  # columns, wider than any table

# typer uses click before 0.26 and its own copy of click since: the class is looked up, not imported.
UsageProblem: type[Any] = next(cls for cls in typer.BadParameter.__mro__ if cls.__name__ == "ClickException")


def _set_verbose(asked: bool) -> bool:
    if asked:
        os.environ["SLAMDEPTH_DEBUG"] = "1"
        show_log(logging.DEBUG)
    return asked


def _set_quiet(asked: bool) -> bool:
    if asked:
        show_log(logging.ERROR)
    return asked


VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=_set_verbose, help="Print every message, and tracebacks of errors."
    ),
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", callback=_set_quiet, help="Print errors and results only.")
]


def is_verbose() -> bool:
    """True where the user wants tracebacks: with ``--verbose``, or where ``SLAMDEPTH_DEBUG`` is set."""
    return bool(os.environ.get("SLAMDEPTH_DEBUG"))


def console() -> Console:
    """Standard output, for results; in a file or a pipe, lines are never broken."""
    from rich.console import Console

    out = Console(highlight=False, soft_wrap=False)
    if not out.is_terminal and "COLUMNS" not in os.environ:
        out.width = _UNBROKEN
    return out


def print_places(out: Console, places: Mapping[str, object]) -> None:
    """Print where each result lies, a line each. Paths are never broken, so that they can be copied."""
    width = max(map(len, places))
    for name, place in places.items():
        out.print(f"  {name:<{width}}   {place}", markup=False, soft_wrap=True)


def print_notes(out: Console, notes: Iterable[str]) -> None:
    """Print notes, a line each that is never broken."""
    for note in notes:
        out.print(f"note: {note}", style="yellow", markup=False, soft_wrap=True)


def error_console() -> Console:
    """Standard error, for progress, warnings and errors."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def show_log(level: int = logging.WARNING, target: Console | None = None) -> None:
    """Print slamdepth's messages of ``level`` and above on standard error; the first call sets the level."""
    package = logging.getLogger("slamdepth")
    known = [handler for handler in package.handlers if getattr(handler, "is_of_cli", False)]
    if known:
        if target is not None:
            known[0].console = target  # type: ignore[attr-defined]
        return
    from rich.logging import RichHandler

    handler = RichHandler(
        level, target or error_console(), show_time=False, show_path=False, markup=False, highlighter=None
    )
    handler.is_of_cli = True  # type: ignore[attr-defined]
    handler.setFormatter(logging.Formatter("%(message)s"))
    package.addHandler(handler)
    package.setLevel(min(level, package.level or level))
