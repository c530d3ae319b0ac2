# SPDX-License-Identifier: Apache-2.0
"""Work that needs nothing but its arguments, done beside the tracker."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import ParamSpec, TypeVar

from slamdepth.tracking.threads import single_threaded

_P = ParamSpec("_P")
_T = TypeVar("_T")


class SideThread:
    """One thread that computes what is taken later, in the order it was asked for.

    A function given to it must read nothing that the tracker changes meanwhile: then what it returns,
    taken at a frame that does not depend on how fast it was, is the same on every machine.

    Args:
        name: told by tools that list threads.
    """

    def __init__(self, name: str = "side") -> None:
        self._pool = ThreadPoolExecutor(1, f"slamdepth-{name}")

    def ask(self, function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Start ``function``; the result is to be taken with ``result()``, which waits and raises."""
        return self._pool.submit(_alone, partial(function, *args, **kwargs))

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=True)


def _alone(task: Callable[[], _T]) -> _T:
    with single_threaded():
        return task()
