# SPDX-License-Identifier: Apache-2.0
"""A sequence of image files, and the checks every layout shares."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.datasets.association import associate
from slamdepth.datasets.base import Dataset
from slamdepth.datasets.intrinsics import CameraSource
from slamdepth.datasets.orientation import UPRIGHT, check_size, turned_image
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_m, read_image_rgb
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_TIME_DIFFERENCE_S = 0.02
"""Two measurements further apart in time do not belong together (TUM's ``associate.py``)."""


@dataclass
class ImageSequence(Dataset):
    """The :class:`~slamdepth.datasets.base.Dataset` of a folder of image files.

    Reading keeps no state, so several threads may read at once.

    Attributes:
        image_paths: ``N`` colour images.
        depth_paths: ``N`` depth images, None for frames without one.
        unknown_raw_depth: raw depth values that mean unknown, besides 0.
        why_no_depth: why no frame has depth although there are depth images; empty elsewhere.
        orientation: EXIF's, of the stored pixels of colour and depth; frames are upright.
    """

    name: str
    path: Path
    camera: Camera
    timestamps_s: NDArray[np.float64]
    image_paths: tuple[Path, ...]
    depth_paths: tuple[Path | None, ...]
    ground_truth: Trajectory | None = None
    notes: list[str] = field(default_factory=list)
    unknown_raw_depth: tuple[int, ...] = ()
    why_no_depth: str = ""
    orientation: int = UPRIGHT
    camera_source: CameraSource = Dataset.camera_source
    has_depth: bool = field(init=False)

    def __post_init__(self) -> None:
        if not len(self.timestamps_s) == len(self.image_paths) == len(self.depth_paths):
            raise ValueError("times, images and depth images must be of one number")
        self.has_depth = any(path is not None for path in self.depth_paths)

    def __len__(self) -> int:
        return len(self.image_paths)

    def files(self) -> Iterable[Path]:
        """See :meth:`slamdepth.datasets.base.Dataset.files`."""
        return (*self.image_paths, *(path for path in self.depth_paths if path is not None))

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: the colour image, or the depth image asked for, does not decode.
            CameraError: the size of either is not the camera's.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        image_rgb = read_image_rgb(self.image_paths[index])
        check_size(self.image_paths[index], image_rgb.shape, self.camera)
        depth_m = None
        depth_path = self.depth_paths[index]
        if with_depth and depth_path is not None:
            depth_m = read_depth_m(depth_path, self.camera.depth_factor, unknown_raw=self.unknown_raw_depth)
            depth_m = self._upright(depth_m)
            check_size(depth_path, depth_m.shape, self.camera)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, self.camera, depth_m)

    def _upright(self, depth_m: Floats32) -> Floats32:
        """Depth ``(H, W)``, which has no EXIF and belongs to the stored pixels, turned as its image is."""
        if self.orientation == UPRIGHT:
            return depth_m
        turned = turned_image(depth_m, self.orientation)
        is_upright = depth_m.shape == (self.camera.height, self.camera.width) != turned.shape
        return depth_m if is_upright else turned


def first_image(paths: tuple[Path, ...]) -> tuple[Path, tuple[int, ...]]:
    """The first image that decodes, and its shape (H, W, 3).

    Raises:
        DatasetError: none does; names the first one's trouble.
    """
    first_error: ImageDecodeError | None = None
    for path in paths:
        try:
            return path, read_image_rgb(path).shape
        except ImageDecodeError as error:
            first_error = first_error or error
    raise DatasetError(f"none of the {len(paths)} images decodes; the first: {first_error}") from first_error


def is_file(path: Path) -> bool:
    """``path.is_file()``, False also for names no file system takes."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_overlap(
    timestamps_s: NDArray[np.float64], ground_truth: Trajectory, ground_truth_path: Path
) -> None:
    """Raise DatasetError where no image has a ground truth pose of about its time."""
    if not associate(timestamps_s, ground_truth.timestamps_s, MAX_TIME_DIFFERENCE_S):
        images, poses = timestamps_s, ground_truth.timestamps_s
        raise DatasetError(
            f"{ground_truth_path}: no pose within {MAX_TIME_DIFFERENCE_S} s of any image: images from "
            f"{images[0]:.3f} to {images[-1]:.3f} s, ground truth from {poses[0]:.3f} to {poses[-1]:.3f} s"
        )
