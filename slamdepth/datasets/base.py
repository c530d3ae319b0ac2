# SPDX-License-Identifier: Apache-2.0
"""The :class:`Dataset` protocol: a sequence of frames, read one at a time."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from slamdepth.datasets.intrinsics import CameraSource, Certainty
from slamdepth.errors import ImageDecodeError
from slamdepth.types import Camera, Frame, Trajectory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_log = logging.getLogger(__name__)


@runtime_checkable
class Dataset(Protocol):
    """A sequence of colour images, read one at a time.

    ``for frame in dataset`` reads them in order. A class that inherits from this one gets the iteration
    and has to provide the attributes, ``__len__`` and :meth:`read`.

    Attributes:
        name: short name, used for run folders.
        path: where it lies.
        camera: its camera.
        camera_source: where the intrinsics come from.
        timestamps_s: ``(N,)`` float64 seconds, strictly increasing.
        has_depth: True where sensor depth can be read.
        ground_truth: poses of the camera, or None.
        truth_source: what ``ground_truth`` is where it was not measured by a second system, such as a
            scanner's own poses; empty elsewhere.
        imu_path: inertial data of the same time, as ``--imu`` reads them; None where there are none.
        layout: name of the reader that opened it; empty where none did.
        is_live: True where frames come as they are taken: ``len`` grows, and only the next frame can be read.
        notes: what was guessed, dropped or repaired while reading, one line each.
    """

    name: str
    path: Path
    camera: Camera
    camera_source: CameraSource = CameraSource(Certainty.GIVEN, "the files of the sequence")
    timestamps_s: NDArray[np.float64]
    has_depth: bool
    ground_truth: Trajectory | None
    truth_source: str = ""
    imu_path: Path | None = None
    layout: str = ""
    is_live: bool = False
    notes: list[str]

    def __len__(self) -> int: ...

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame.

        Args:
            index: 0 to ``len(self) - 1``.
            with_depth: also read the sensor depth; the frame's ``depth_m`` is None
                where this frame has none.

        Raises:
            IndexError: there is no frame ``index``.
            ImageDecodeError: the image, or the depth image asked for, does not decode.
            CameraError: the size of either is not the camera's.
            SourceEnded: a live source gives no more frames.
        """
        ...

    def files(self) -> Iterable[Path]:
        """The images and depth images that it reads, where they are files of their own."""
        return ()

    def close(self) -> list[str]:
        """Release what is held open, such as a camera; nothing can be read afterwards from a live source.

        Returns:
            What happened while it was read, one line each.
        """
        return []

    def read_original(self, index: int) -> Frame:
        """Read the colour image of a frame in the size it was recorded in, with the camera of that size.

        :meth:`read` may give a smaller one.

        Raises:
            IndexError, ImageDecodeError, CameraError: as :meth:`read`.
        """
        return self.read(index)

    def __iter__(self) -> Iterator[Frame]:
        """Every frame in order, with sensor depth where there is any; see :meth:`frames`."""
        return self.frames(with_depth=self.has_depth)

    def frames(self, *, with_depth: bool = False) -> Iterator[Frame]:
        """Read every frame in order.

        A frame whose image does not decode is skipped and a depth image that does not decode is left out,
        both with a logged warning, as in ``slamdepth run``. ``frame.index`` is the frame's place in the
        sequence, so skipped frames leave gaps.

        Args:
            with_depth: also read the sensor depth.

        Raises:
            CameraError: the size of an image is not the camera's.
        """
        for index in range(len(self)):
            try:
                frame, depth_error = read_sound(self, index, with_depth=with_depth)
            except ImageDecodeError as error:
                _log.warning("image skipped: %s", error)
                continue
            if depth_error is not None:
                _log.warning("depth of frame %d left out: %s", index, depth_error)
            yield frame


def read_sound(dataset: Dataset, index: int, *, with_depth: bool) -> tuple[Frame, ImageDecodeError | None]:
    """The frame ``index``; without its depth, and with the error, where only that does not decode.

    Raises:
        IndexError, ImageDecodeError, CameraError: as :meth:`Dataset.read`, of the colour image.
    """
    try:
        return dataset.read(index, with_depth=with_depth), None
    except ImageDecodeError as error:
        if not with_depth:
            raise
        return dataset.read(index), error  # raises again where it is the colour image
