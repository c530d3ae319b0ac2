# SPDX-License-Identifier: Apache-2.0
"""A folder of images as a sequence, taken at equal intervals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets.image_files import has_images, list_images
from slamdepth.datasets.intrinsics import CameraSource, Certainty, intrinsics_of_images
from slamdepth.datasets.orientation import check_size, exif_orientation, fitted_camera
from slamdepth.datasets.registry import register_last_reader
from slamdepth.datasets.resizing import reduced_camera, reduced_image
from slamdepth.datasets.sequence import ImageSequence, first_image
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import read_depth_file, read_image_rgb
from slamdepth.types import Camera, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

PAIRS_FILE = "camera.json"
"""Marks a folder of training pairs, half of whose images are depth."""

_RUN_FILES = ("report.json", "trajectory_online.txt", "config.yaml")
"""Mark a run folder, whose only image is one of the mesh."""


@register_last_reader
class ImagesReader:
    """Opens folders of images without another layout."""

    name = "images"
    needs = "a folder of images, in the order of their names; optional camera.yaml in it"

    def matches(self, path: Path) -> bool:
        return has_images(path) and not (path / PAIRS_FILE).exists()

    def open(self, path: Path, camera: Camera | None) -> FolderSequence:
        if all((path / name).is_file() for name in _RUN_FILES):
            raise DatasetError(
                f"{path}: is the folder of a run, not a recording: name what was run, or see the result with "
                "'slamdepth view'"
            )
        return self.open_list(path, tuple(list_images(path)), camera)

    def open_list(self, path: Path, images: tuple[Path, ...], camera: Camera | None) -> FolderSequence:
        """Open some images of the folder ``path`` in this order; see :meth:`open`."""
        notes: list[str] = []
        _check_names(path, images)
        sample_path, sample_shape = first_image(images)
        _check_no_depth(sample_path)
        source = CameraSource(Certainty.GIVEN, "--camera")
        camera_path = path / CAMERA_FILE
        if camera is None and camera_path.exists():
            camera = Camera.from_file(camera_path, notes)
            source = CameraSource(Certainty.GIVEN, CAMERA_FILE)
        orientation = exif_orientation(sample_path, notes)
        if camera is None:
            camera, source = intrinsics_of_images(sample_path, sample_shape[1], sample_shape[0])
        else:
            camera = fitted_camera(sample_path, sample_shape, camera, orientation, notes)
        return FolderSequence(path, camera, images, notes, source)


class FolderSequence(ImageSequence):
    """The :class:`~slamdepth.datasets.base.Dataset` of a folder of images; large ones are reduced.

    Args:
        taken_by: the camera of the upright images in their own size; its ``fps`` gives the times.
        notes: takes a line for each assumption.
        source: where the camera comes from.
    """

    def __init__(
        self,
        path: Path,
        taken_by: Camera,
        images: tuple[Path, ...],
        notes: list[str],
        source: CameraSource = ImageSequence.camera_source,
    ) -> None:
        notes.append(
            f"times are counted: {len(images)} images in the order of their names, {images[0].name} to "
            f"{images[-1].name}, {taken_by.fps:g} a second (fps of the camera file, 30 where it says none)"
        )
        times_s: NDArray[np.float64] = np.arange(len(images)) / taken_by.fps
        camera = reduced_camera(taken_by, notes)
        without = (None,) * len(images)
        super().__init__(
            path.resolve().name, path, camera, times_s, images, without, None, notes, camera_source=source
        )
        self._original_size = taken_by.width, taken_by.height

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: the image does not decode.
            CameraError: its size is not that of the camera it was taken by.
        """
        del with_depth
        image_rgb = reduced_image(self.read_original(index).image_rgb, self.camera)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, self.camera)

    def read_original(self, index: int) -> Frame:
        """Read one frame in its own size; raises as :meth:`read`."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        image_rgb = read_image_rgb(self.image_paths[index])
        taken_by = self.camera.scaled(*self._original_size)
        check_size(self.image_paths[index], image_rgb.shape, taken_by)
        return Frame(index, float(self.timestamps_s[index]), image_rgb, taken_by)


def _check_names(path: Path, images: tuple[Path, ...]) -> None:
    by_stem: dict[str, Path] = {}
    for image in images:
        other = by_stem.setdefault(image.stem, image)
        if other is not image:
            raise DatasetError(
                f"{path}: {other.name} and {image.name} are one image or an image and its depth: leave only "
                "the images of the sequence in the folder"
            )


def _check_no_depth(path: Path) -> None:
    try:
        image = read_depth_file(path)
    except ImageDecodeError:
        return
    if image.ndim == 2 and image.dtype.itemsize > 1:
        raise DatasetError(
            f"{path}: has {8 * image.dtype.itemsize} bits of grey, as depth images have; a sequence is of "
            "images of 8 bits"
        )
