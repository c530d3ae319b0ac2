# SPDX-License-Identifier: Apache-2.0
"""Writing a video frame by frame, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import OutputError
from slamdepth.io import replacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

CODECS = ("vp09", "mp4v")
"""In order of preference. Browsers play VP9, and OpenCV's own FFmpeg can write it, unlike H.264."""

MIN_FPS = 1.0
"""Least frame rate: images that are far apart in time are shown for a second each."""


@contextmanager
def video_writer(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write an mp4 file; it is moved to ``path`` when the block succeeds.

    Args:
        path: the file.
        fps: frames per second, raised to :data:`MIN_FPS` where it is less.

    Yields:
        A function that adds a frame ``(H, W, 3)`` uint8 RGB. All frames have one size, both sides even.

    Raises:
        OutputError: OpenCV has no codec, or ``path`` cannot be written.
    """
    import cv2

    writer: Any = None
    with replacing(path) as temporary:

        def add(frame_rgb: NDArray[np.uint8]) -> None:
            nonlocal writer
            if writer is None:
                writer = _open(temporary, path, max(fps, MIN_FPS), frame_rgb.shape[1], frame_rgb.shape[0])
            writer.write(cv2.cvtColor(frame_rgb, cv2.COLOR_RGB2BGR))

        try:
            yield add
        finally:
            if writer is not None:
                writer.release()
        if not temporary.is_file() or temporary.stat().st_size == 0:
            raise OutputError(f"{path}: the video could not be written")


def _open(temporary: Path, path: Path, fps: float, width: int, height: int) -> Any:
    import cv2

    for codec in CODECS:
        writer = cv2.VideoWriter(
            str(temporary), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, (width, height)
        )
        if writer.isOpened():
            return writer
    raise OutputError(f"{path}: this OpenCV can write neither VP9 nor MPEG-4 video")
