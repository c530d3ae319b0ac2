# SPDX-License-Identifier: Apache-2.0
"""A video file as a sequence without depth and ground truth."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from slamdepth.datasets.base import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of_video
from slamdepth.datasets.orientation import fitted_camera
from slamdepth.datasets.registry import register_reader
from slamdepth.datasets.resizing import reduced_camera, reduced_image
from slamdepth.datasets.video import VIDEO_ENDINGS, VideoFile
from slamdepth.errors import ImageDecodeError
from slamdepth.types import Camera, Frame, Trajectory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEFAULT_FPS = 30.0
"""``fps`` of a camera whose file says none."""


@register_reader
class VideoReader:
    """Opens video files."""

    name = "video"
    needs = f"a file {', '.join(VIDEO_ENDINGS)}"

    def matches(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in VIDEO_ENDINGS

    def open(self, path: Path, camera: Camera | None) -> VideoSequence:
        video = VideoFile(path)
        notes: list[str] = []
        if camera is None:  # a camera.yaml next to a video may belong to another one
            camera, source = intrinsics_of_video(path, video.width, video.height)
        else:
            source = CameraSource(Certainty.GIVEN, "--camera")
            size = (video.height, video.width)
            camera = fitted_camera(path, size, camera, video.orientation, notes)
        return VideoSequence(video, camera, notes, source)


class VideoSequence(Dataset):
    """The :class:`~slamdepth.datasets.base.Dataset` of a video.

    Frames are decoded in order, so reading forwards is fast; a step back starts from the first frame again.
    Several threads may read, one at a time.

    Attributes:
        frames_promised: number of frames by the video's header; more than ``len(self)`` where it was cut
            short or is damaged.

    Args:
        camera: for upright images of the video's own size.
        notes: what is known of both already.
        source: where the camera comes from.
    """

    has_depth = False
    ground_truth: Trajectory | None = None

    def __init__(
        self,
        video: VideoFile,
        camera: Camera,
        notes: Sequence[str] = (),
        source: CameraSource = Dataset.camera_source,
    ) -> None:
        self.name, self.path = video.path.stem, video.path
        # A camera file without fps has the default, which says less than the video.
        camera_fps = camera.fps if camera.fps != DEFAULT_FPS else None
        self.timestamps_s = video.timestamps_s(camera_fps)
        self.notes = [*notes, *video.notes]
        missing = video.missing_note(len(self), self.timestamps_s)
        self.frames_promised = video.frames_named if missing else len(self)
        self.notes += [missing] if missing else []
        self.camera = replace(reduced_camera(camera, self.notes), fps=video.fps)
        self._original_size = camera.width, camera.height
        self.camera_source = source
        self._video = video
        self._lock = threading.Lock()
        self._frames = video.frames()
        self._next = 0

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: the frame does not decode.
        """
        del with_depth
        image_rgb = self._read(index, self.camera)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, self.camera)

    def read_original(self, index: int) -> Frame:
        """Read one frame in the video's own size; raises as :meth:`read`."""
        taken_by = self.camera.scaled(*self._original_size)
        image_rgb = self._read(index, taken_by)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, taken_by)

    def _read(self, index: int, camera: Camera) -> NDArray[np.uint8]:
        """The image ``(H, W, 3)`` of a frame in the size of ``camera``."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        with self._lock:  # the decoder's buffer holds the frame until the next one is taken
            return reduced_image(self._decoded(index), camera)

    def _decoded(self, index: int) -> NDArray[np.uint8]:
        if index < self._next:
            self._frames, self._next = self._video.frames(), 0
        for number, decode in self._frames:
            self._next = number + 1
            if number == index:
                return decode()
        raise ImageDecodeError(f"{self.path.name}: the video ends before frame {index}")
