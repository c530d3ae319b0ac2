# SPDX-License-Identifier: Apache-2.0
"""Video files, decoded one frame at a time in order, by the FFmpeg inside OpenCV."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.datasets.orientation import OF_ROTATION_DEG, UPRIGHT
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
_FALLBACK_FPS = 30.0
_COUNTED_ENDINGS = (".mp4", ".m4v", ".mov", ".avi")
"""Containers that hold the number of frames itself."""
_FEWEST_MISSING = 2
"""One frame is often lost where a decoder starts or ends."""
_CONSTANT_RATE = 0.1


def videos_in(folder: Path) -> list[Path]:
    """The video files of a folder, sorted; none where it is no folder."""
    inside = folder.iterdir() if folder.is_dir() else ()
    return sorted(one for one in inside if one.suffix.lower() in VIDEO_ENDINGS)


class VideoFile:
    """A video: its size and rate, and its frames.

    Attributes:
        path: the file.
        width, height: of a frame in pixels, turned upright as the file says.
        fps: frames per second; 30 where the file does not say, with a note.
        orientation: of the stored pixels, as EXIF numbers it, by the file's rotation flag.
        frames_named: number of frames by the file's header, which may be wrong; 0 where it has none.
        notes: what was guessed, one line each.

    Raises:
        DatasetError: the file is missing, is no video, or not one of its frames decodes.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        if not path.is_file():
            raise DatasetError(f"{path}: no such video file")
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
            rotation_deg = round(float(capture.get(cv2.CAP_PROP_ORIENTATION_META))) % 360
        finally:
            capture.release()
        self.orientation = OF_ROTATION_DEG.get(rotation_deg, UPRIGHT)
        self.fps = fps if 0.1 <= fps <= 1000.0 else _FALLBACK_FPS
        if self.fps != fps:
            self.notes.append(f"the video names no usable frame rate; {_FALLBACK_FPS:g} Hz is assumed")
        self.frames_named = round(named) if 0 < named < 1e9 else 0

    def timestamps_s(self, camera_fps: float | None = None) -> Floats:
        """``(N,)`` times of all frames in seconds from the first; reads the whole video once.

        A phone's frames do not come at equal intervals, so the time of each is read. Where times do not
        increase, they are counted, with a note.

        Args:
            camera_fps: frame rate by the camera file; it becomes :attr:`fps` where times are counted.
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
            by = "as the video names" if camera_fps is None else "fps of the camera file"
            self.fps = self.fps if camera_fps is None else camera_fps
            are = "are all the same" if (found == found[0]).all() else "do not increase"
            self.notes.append(f"the times of the video's frames {are}; {self.fps:g} Hz ({by}) is assumed")
            return np.asarray(np.arange(len(found)) / self.fps)
        return np.asarray(found - found[0])

    def missing_note(self, frames: int, times_s: Floats | None = None) -> str:
        """A line on the frames that the header promises in addition to the ``frames`` that can be read; empty
        where none are missing, or where the header's number is none or a mere estimate.

        Args:
            times_s: ``(N,)`` times in seconds, which tell whether an estimate holds.
        """
        missing = self.frames_named - frames
        is_counted = self.path.suffix.lower() in _COUNTED_ENDINGS
        if not is_counted and times_s is not None and len(times_s) > 1:
            # Other containers hold a duration, of which FFmpeg makes a number of frames at a constant rate.
            is_counted = abs(float(np.median(np.diff(times_s))) * self.fps - 1.0) < _CONSTANT_RATE
        if missing < _FEWEST_MISSING or not is_counted:
            return ""
        return (
            f"the video promises {self.frames_named} frames, {frames} can be read: {missing} are missing; it "
            "was cut short or is damaged"
        )

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

        capture = quiet_capture(str(self.path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise DatasetError(f"{self.path}: no video that can be read: cut short, or of an unknown format")
        return capture

    def _decode(self, capture: Any, index: int) -> NDArray[np.uint8]:
        import cv2

        decoded, image = capture.retrieve()
        if not decoded or image is None or image.shape != (self.height, self.width, 3):
            raise ImageDecodeError(f"{self.path.name}: frame {index} does not decode")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def quiet_capture(*arguments: Any) -> Any:
    """OpenCV's ``VideoCapture``; it and FFmpeg print no errors, which would break the progress bar."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(*arguments)
    finally:
        cv2.utils.logging.setLogLevel(level)
