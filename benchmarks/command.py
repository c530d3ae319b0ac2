# SPDX-License-Identifier: Apache-2.0
"""What the command lines of the benchmarks share."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

from slamdepth.errors import SlamdepthError

_P = ParamSpec("_P")


def errors_in_one_line(main: Callable[_P, int]) -> Callable[_P, int]:
    """Make a :class:`SlamdepthError` in ``main`` one line on standard error and its exit code."""

    @wraps(main)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> int:
        try:
            return main(*args, **kwargs)
        except SlamdepthError as error:
            print(f"error: {error}", file=sys.stderr)
            return error.exit_code

    return wrapped


def parser_of(benchmark: str, doc: str | None) -> argparse.ArgumentParser:
    """The parser of ``python -m benchmarks.BENCHMARK``; its help is the module's docstring."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{benchmark}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def comma_separated(text: str) -> list[str]:
    """The names in ``a, b,c``; empty ones are left out."""
    return [name for name in (part.strip() for part in text.split(",")) if name]


def progress_line(text: str) -> None:
    """Print progress with the time on standard error, apart from the tables."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)
