# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM as an event, so that a job can stop without losing anything."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from slamdepth.errors import SlamdepthError

if TYPE_CHECKING:
    from types import FrameType


class Interrupted(SlamdepthError):
    """The user interrupted a command."""

    exit_code = 130


@contextmanager
def telling_what_is_kept(kept: Callable[[], str]) -> Iterator[None]:
    """Ctrl-C ends the block at once, with one line that says what is kept.

    Args:
        kept: called then; returns what is kept, as a phrase.

    Raises:
        Interrupted: Ctrl-C was pressed.
    """
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise Interrupted(f"interrupted: {kept()}") from interrupt


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; the second one raises KeyboardInterrupt."""
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
