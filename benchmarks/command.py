# SPDX-License-Identifier: Apache-2.0
"""How the command of a benchmark ends."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

from slamdepth.errors import SlamdepthError

_P = ParamSpec("_P")


def errors_in_one_line(main: Callable[_P, int]) -> Callable[_P, int]:
    """An error made on purpose ends ``main`` with one line on standard error and its exit code."""

    @wraps(main)
    def ended(*args: _P.args, **kwargs: _P.kwargs) -> int:
        try:
            return main(*args, **kwargs)
        except SlamdepthError as error:
            print(f"error: {error}", file=sys.stderr)
            return error.exit_code

    return ended
