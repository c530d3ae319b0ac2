# SPDX-License-Identifier: Apache-2.0
"""How the loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Decorator: compile a function at its first call; later runs read it from numba's cache on disk.

    Without reordering of sums (no fast-math), so that results are the same every time.
    """
    try:
        jitted: _F = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder for a cache can be written
        jitted = numba.njit(nogil=True, error_model="numpy")(function)
    return jitted


def inlined(function: _F) -> _F:
    """Decorator: compile a function that compiled ones of the same file call.

    The cache of a function does not see changes of other files.
    """
    jitted: _F = numba.njit(nogil=True, error_model="numpy")(function)
    return jitted
