# SPDX-License-Identifier: Apache-2.0
"""Work that has to be done before the next frame is placed, done while the caller fetches that frame."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

from slamdepth.tracking.side_thread import SideThread


class BetweenFrames:
    """One task at a time in a thread of its own; whoever needs what it changes waits for it first.

    What comes out does not depend on how fast it is: it is as if the task were done at the beginning of
    the next frame.
    """

    def __init__(self) -> None:
        self._thread = SideThread("between")
        self._task: Future[object] | None = None

    def begin(self, task: Callable[[], object]) -> None:
        """Start ``task``; the one before has been waited for."""
        assert self._task is None
        self._task = self._thread.ask(task)

    def wait(self) -> None:
        """Wait for the task, should there be one, and raise what it raised."""
        task, self._task = self._task, None
        if task is not None:
            task.result()

    def close(self) -> None:
        """End the thread."""
        self._thread.close()
