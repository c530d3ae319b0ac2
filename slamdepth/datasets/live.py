# SPDX-License-Identifier: Apache-2.0
"""A camera or a network stream as a sequence that grows while it is read.

A thread takes frames as they come and keeps the newest one only: whoever reads slower than they come misses
some, which are counted, and is never behind.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets.base import Dataset
from slamdepth.datasets.intrinsics import CameraSource
from slamdepth.datasets.resizing import reduced_camera, reduced_image
from slamdepth.datasets.video import quiet_capture
from slamdepth.errors import DatasetError, ImageDecodeError, SourceEnded
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Bytes, Floats

_log = logging.getLogger(__name__)

_FALLBACK_FPS = 30.0
_FIRST_TIMES = 1024
_OPENING_S = 15.0
_IDLE_S = 0.01


class LiveCapture:
    """Frames of a camera or an address, the newest one at a time.

    Attributes:
        width, height, fps: of the frames.
        dropped: frames that came while the one before had not been taken yet, since the first was taken.

    Args:
        source: number of a camera, or an address.
        name: names it in messages, without what is secret in the address.
        stall_s: a source without a frame for so long has ended.

    Raises:
        DatasetError: it cannot be opened, or gives no frame.
    """

    def __init__(self, source: int | str, name: str, stall_s: float) -> None:
        self.name, self.dropped = name, 0
        self._stall_s = stall_s
        self._capture = _opened(source, name, stall_s)
        self._has_new = threading.Condition()
        self._newest: tuple[float, Bytes] | None = None
        self._taken = False
        self._why_ended = ""
        self._closed = threading.Event()
        decoded, image = self._capture.read()
        if not decoded or image is None or image.ndim != 3:
            self._capture.release()
            raise DatasetError(f"{name}: opens, but gives no frame")
        self.height, self.width = image.shape[:2]
        self.fps, self._is_file = _rate(self._capture)
        self._start_s = time.monotonic()
        self._newest = (0.0, image)
        self._thread = threading.Thread(target=self._run, name="slamdepth-capture", daemon=True)
        self._thread.start()

    def take(self) -> tuple[float, Bytes]:
        """The newest frame that was not taken yet: seconds since the first, and ``(H, W, 3)`` uint8 BGR.

        Raises:
            SourceEnded: there will be none, or none came in time.
        """
        with self._has_new:
            if not self._has_new.wait_for(lambda: self._newest is not None or self._why_ended, self._stall_s):
                raise SourceEnded(f"{self.name}: no frame for {self._stall_s:g} s: the source stalled")
            if self._newest is None:
                raise SourceEnded(f"{self.name}: {self._why_ended}")
            newest, self._newest, self._taken = self._newest, None, True
            return newest

    def close(self) -> None:
        """End the thread, which releases the source; one that is stalled is left to itself."""
        self._closed.set()
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                decoded, image = self._capture.read()
                if not decoded or image is None:
                    self._end("the source ended")
                    return
                time_s = time.monotonic() - self._start_s
                if self._is_file:
                    time_s = self._paced()
                if image.shape == (self.height, self.width, 3):
                    self._put(time_s, image)
        finally:
            self._capture.release()
            self._end("closed")

    def _paced(self) -> float:
        """Wait until a frame of a file is due, as if it were taken now; returns its time."""
        import cv2

        due_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3
        wait_s = due_s - (time.monotonic() - self._start_s)
        if 0 < wait_s < self._stall_s:
            self._closed.wait(wait_s)
        return due_s

    def _put(self, time_s: float, image: Bytes) -> None:
        with self._has_new:
            if self._newest is not None and self._taken:
                self.dropped += 1
            self._newest = (time_s, image)
            self._has_new.notify()

    def _end(self, why: str) -> None:
        with self._has_new:
            self._why_ended = self._why_ended or why
            self._has_new.notify()


class LiveSequence(Dataset):
    """The :class:`~slamdepth.datasets.base.Dataset` of a live source.

    Only the next frame can be read, once. ``len`` is the number of frames so far.

    Args:
        camera: of the frames in their own size.
        seconds: end after this time; None: when the source does.
    """

    has_depth = False
    ground_truth: Trajectory | None = None
    is_live = True

    def __init__(
        self, name: str, capture: LiveCapture, camera: Camera, source: CameraSource, seconds: float | None
    ) -> None:
        self.name, self.path = name, Path(capture.name)
        self.notes: list[str] = []
        self.camera = reduced_camera(camera, self.notes)
        self.camera_source = source
        self._capture, self._seconds = capture, seconds
        self._times_s: Floats = np.empty(_FIRST_TIMES)
        self._count = 0
        self.timestamps_s: Floats = self._times_s[:0]

    def __len__(self) -> int:
        return self._count

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Wait for the next frame.

        Args:
            index: the number of the last frame read, and 1 or more; frames between are left out.

        Raises:
            ImageDecodeError: the frame was read before; none is kept.
            SourceEnded: the source ended or stalled, or the time is over.
        """
        del with_depth
        import cv2

        if index < self._count:
            raise ImageDecodeError(f"{self.name}: frame {index} of a live source is not kept")
        while True:
            time_s, image = self._capture.take()
            if self._seconds is not None and time_s > self._seconds:
                raise SourceEnded(f"{self.name}: stopped after {self._seconds:g} s")
            if self._count and time_s <= self._times_s[self._count - 1]:
                continue
            self._note_time(time_s)
            if self._count > index:
                break
        image_rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
        return Frame(index, time_s, reduced_image(image_rgb, self.camera), self.camera)

    def close(self) -> list[str]:
        """See :meth:`slamdepth.datasets.base.Dataset.close`."""
        self._capture.close()
        dropped = self._capture.dropped
        if not dropped:
            return []
        return [
            f"{dropped} frames of the live source came too fast and were left out, {self._count} were read"
        ]

    def _note_time(self, time_s: float) -> None:
        if self._count == len(self._times_s):
            self._times_s = np.concatenate([self._times_s, np.empty(self._count)])
        self._times_s[self._count] = time_s
        self._count += 1
        self.timestamps_s = self._times_s[: self._count]


def _opened(source: int | str, name: str, stall_s: float) -> Any:
    import cv2

    if isinstance(source, int):
        capture = quiet_capture(source)
    else:
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(1e3 * min(stall_s, _OPENING_S)),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(1e3 * stall_s),
        ]
        capture = quiet_capture(source, cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        what = "no such camera, or another program uses it" if isinstance(source, int) else "no video there"
        raise DatasetError(f"{name}: cannot be opened: {what}")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture


def _rate(capture: Any) -> tuple[float, bool]:
    """Frames a second, and whether it is a file: one with a number of frames, read as fast as one likes."""
    import cv2

    fps = float(capture.get(cv2.CAP_PROP_FPS))
    is_file = 0 < float(capture.get(cv2.CAP_PROP_FRAME_COUNT)) < 1e9
    return (fps if 1.0 <= fps <= 1000.0 else _FALLBACK_FPS), is_file
