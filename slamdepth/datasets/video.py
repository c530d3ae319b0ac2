# SPDX-License-Identifier: Apache-2.0
"""Video files, decoded one frame at a time in order, by the FFmpeg inside OpenCV."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
_FALLBACK_FPS = 30.0


class VideoFile:
    """A video: its size and rate, and its frames.

    Attributes:
        path: the file.
        width, height: of a frame in pixels, turned upright as the file says.
        fps: frames per second; 30 where the file does not say, with a note.
        frames_named: number of frames by the file's header, which may be wrong; 0 where it has none.
        notes: what was guessed, one line each.

    Raises:
        DatasetError: the file is missing, is no video, or not one of its frames decodes.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        if not path.is_file():
            raise DatasetError(f"{path}: no such video file")
        # FFmpeg prints errors of its own, as OpenCV does in _open; they would break the progress bar.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        self.path = path
        self.notes: list[str] = []
        capture = self._open()
        try:
            decoded, image = capture.read()
            if not decoded or image is None:
                raise DatasetError(f"{path}: no frame of this video decodes (is the file whole?)")
            self.height, self.width = image.shape[:2]
            fps = float(capture.get(cv2.CAP_PROP_FPS))
            named = float(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        finally:
            capture.release()
        if not 0.1 <= fps <= 1000.0:
            self.notes.append(f"the video names no usable frame rate; {_FALLBACK_FPS:g} Hz is assumed")
            fps = _FALLBACK_FPS
        self.fps = fps
        self.frames_named = round(named) if 0 < named < 1e9 else 0

    def timestamps_s(self) -> Floats:
        """``(N,)`` times of all frames in seconds from the first; reads the whole video once.

        A phone's frames do not come at equal intervals, so the time of each is read. Where times do not
        increase, they follow from :attr:`fps`, with a note.
        """
        import cv2

        capture, times_s = self._open(), []
        try:
            while capture.grab():
                times_s.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
        finally:
            capture.release()
        found: Floats = np.array(times_s)
        if len(found) > 1 and not (np.diff(found) > 0).all():
            self.notes.append(f"the times of the video's frames do not increase; {self.fps:g} Hz is assumed")
            return np.asarray(np.arange(len(found)) / self.fps)
        return np.asarray(found - found[0])

    def frames(self, stride: int = 1) -> Iterator[tuple[int, Callable[[], NDArray[np.uint8]]]]:
        """Every ``stride``-th frame: its number from 0, and a function that decodes it.

        The function returns ``(H, W, 3)`` uint8 RGB and may be called until the next frame is taken.
        Frames that are not decoded cost less.

        Raises:
            ImageDecodeError: from the function, the frame does not decode.
        """
        capture = self._open()
        try:
            index = 0
            while capture.grab():
                if index % stride == 0:
                    yield index, partial(self._decode, capture, index)
                index += 1
        finally:
            capture.release()

    def _open(self) -> Any:
        import cv2

        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            raise DatasetError(f"{self.path}: no video that can be read: cut short, or of an unknown format")
        return capture

    def _decode(self, capture: Any, index: int) -> NDArray[np.uint8]:
        import cv2

        decoded, image = capture.retrieve()
        if not decoded or image is None or image.shape != (self.height, self.width, 3):
            raise ImageDecodeError(f"{self.path.name}: frame {index} does not decode")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
