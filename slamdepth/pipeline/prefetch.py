# SPDX-License-Identifier: Apache-2.0
"""Frames read and prepared ahead in a thread, in order, while others are tracked."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from slamdepth.datasets import Dataset
from slamdepth.datasets.base import read_sound
from slamdepth.errors import ImageDecodeError, SourceEnded
from slamdepth.types import Frame

logger = logging.getLogger(__name__)

_POLL_S = 0.1
_WARNINGS = 5
"""Depth images named one by one before they are only counted."""


@dataclass(frozen=True)
class ReadFrame:
    """A frame, and what ``prepare`` returned for it."""

    frame: Frame
    prepared: Any = None


class FramePrefetcher:
    """Iterates over frames of a dataset; a limited number is read ahead.

    A context manager; leaving it ends the thread.

    Args:
        dataset: the sequence.
        indices: which frames, in the order they come out.
        with_depth: also read the sensor depth; it is None where a frame has none or it does not decode.
        prepare: called with each frame, in the thread.
        capacity: frames read ahead.

    Attributes:
        read_s: seconds spent on reading.
        broken_depth_images: depth images that did not decode.
        ended: why a live source ended; empty where none did.
    """

    def __init__(
        self,
        dataset: Dataset,
        indices: Sequence[int],
        *,
        with_depth: bool,
        prepare: Callable[[Frame], Any] | None = None,
        capacity: int = 8,
    ) -> None:
        self._dataset = dataset
        self._indices = indices
        self._with_depth = with_depth
        self._prepare = prepare
        self._queue: queue.Queue[ReadFrame | Exception | None] = queue.Queue(maxsize=capacity)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._read_all, name="slamdepth-reader", daemon=True)
        self.read_s = 0.0
        self.broken_depth_images = 0
        self.ended = ""

    def __enter__(self) -> FramePrefetcher:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed.set()
        self._thread.join()

    def __iter__(self) -> Iterator[ReadFrame | ImageDecodeError]:
        """Each frame, or the error of an image that does not decode.

        Raises:
            CameraError: the size of an image is not the camera's.
        """
        while (item := self._queue.get()) is not None:
            if isinstance(item, Exception) and not isinstance(item, ImageDecodeError):
                raise item
            yield item

    def _read_all(self) -> None:
        for index in self._indices:
            start = time.perf_counter()
            try:
                frame = self._read(index)
                self.read_s += time.perf_counter() - start
                item: ReadFrame | Exception = ReadFrame(
                    frame, None if self._prepare is None else self._prepare(frame)
                )
            except SourceEnded as error:
                self.ended = str(error)
                break
            except Exception as error:  # raised by the thread that iterates
                item = error
            if not self._put(item):
                return
        self._put(None)

    def _read(self, index: int) -> Frame:
        frame, error = read_sound(self._dataset, index, with_depth=self._with_depth)
        if error is not None:
            self.broken_depth_images += 1
            level = logging.WARNING if self.broken_depth_images <= _WARNINGS else logging.DEBUG
            logger.log(level, "depth of frame %d left out: %s", index, error)
            if self.broken_depth_images == _WARNINGS:
                logger.warning("further depth images that do not decode are only counted")
        return frame

    def _put(self, item: ReadFrame | Exception | None) -> bool:
        while not self._closed.is_set():
            try:
                self._queue.put(item, timeout=_POLL_S)
                return True
            except queue.Full:
                continue
        return False
