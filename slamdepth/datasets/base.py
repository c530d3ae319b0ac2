# SPDX-License-Identifier: Apache-2.0
"""What a sequence is, to the rest of the house."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from slamdepth.types import Camera, Frame, Trajectory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@runtime_checkable
class Dataset(Protocol):
    """A sequence of colour images, read one at a time.

    Attributes:
        name: short name, used for run folders.
        path: where it lies.
        camera: its camera.
        timestamps_s: ``(N,)`` float64 seconds, strictly increasing.
        has_depth: True where sensor depth can be read.
        ground_truth: poses of the camera, or None.
        notes: what was guessed, dropped or repaired while reading, one line each.
    """

    name: str
    path: Path
    camera: Camera
    timestamps_s: NDArray[np.float64]
    has_depth: bool
    ground_truth: Trajectory | None
    notes: list[str]

    def __len__(self) -> int: ...

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame.

        Args:
            index: 0 to ``len(self) - 1``.
            with_depth: also read the sensor depth; the frame's ``depth_m`` is None
                where this frame has none.

        Raises:
            ImageDecodeError: the image does not decode.
            CameraError: its size is not the camera's.
        """
        ...
