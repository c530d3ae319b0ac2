# SPDX-License-Identifier: Apache-2.0
"""What depth can be judged on: a sequence with sensor depth, or a folder of training pairs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from slamdepth.datasets import open_dataset
from slamdepth.depth.training.data import open_place
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.types import Frame

logger = logging.getLogger(__name__)

SEQUENCE_STRIDE = 10


@dataclass(frozen=True)
class DepthData:
    """Frames with sensor depth.

    Attributes:
        name: of the folder.
        indices: which of its frames are meant.
        read: a frame by its index, with depth.
    """

    name: str
    indices: range
    read: Callable[[int], Frame]

    def __len__(self) -> int:
        return len(self.indices)

    def frames(self) -> Iterator[Frame]:
        """The frames in order; one that does not decode is left out with a warning."""
        for index in self.indices:
            try:
                yield self.read(index)
            except ImageDecodeError as error:
                logger.warning("frame left out: %s", error)


def open_depth_data(
    path: Path, *, camera: Path | None = None, stride: int | None = None, max_frames: int | None = None
) -> DepthData:
    """Open a folder of any known sequence layout, or of training pairs (``camera.json``).

    Args:
        camera: a ``camera.yaml`` for the sequence.
        stride: every so many frames; default: 10 of a sequence, 1 of training pairs, which
            are thinned already.
        max_frames: no more than so many, the first ones.

    Raises:
        DatasetError: the folder is of no known layout or malformed, or has no sensor depth.
        CameraError: the intrinsics of a sequence are unknown or malformed.
    """
    if (path / "camera.json").is_file():
        if camera is not None:
            raise DatasetError(f"{path}: training pairs have their camera.json; leave out --camera")
        place = open_place(path)
        indices = range(0, len(place), stride or 1)[:max_frames]
        return DepthData(place.name, indices, place.read)
    dataset = open_dataset(path, camera)
    if not dataset.has_depth:
        raise DatasetError(f"{path}: has no sensor depth to judge a prediction by")
    indices = range(0, len(dataset), stride or SEQUENCE_STRIDE)[:max_frames]
    return DepthData(dataset.name, indices, lambda index: dataset.read(index, with_depth=True))
