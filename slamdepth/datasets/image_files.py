# SPDX-License-Identifier: Apache-2.0
"""Image files without a sequence layout: a single one, or a folder of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from slamdepth.datasets.intrinsics import Certainty, Intrinsics, exif_focal_35mm, intrinsics_of
from slamdepth.datasets.orientation import exif_orientation, fitted_camera
from slamdepth.datasets.virtual_view import as_pinhole
from slamdepth.errors import DatasetError
from slamdepth.io import read_image_rgb
from slamdepth.types import Camera, Frame

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


def list_images(folder: Path) -> list[Path]:
    """The images in ``folder``, not in folders below, in natural order: 2 before 10.

    Raises:
        DatasetError: the folder cannot be read or holds no image.
    """
    try:
        images = list(_images_in(folder))
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror or error}") from error
    if not images:
        endings = ", ".join(ending.removeprefix(".") for ending in IMAGE_ENDINGS)
        raise DatasetError(f"{folder}: no images in it ({endings}), and no known sequence layout")
    return sorted(images, key=lambda path: (natural_key(path.name), path.name))


def has_images(folder: Path) -> bool:
    """True where ``folder`` is a folder with an image in it; folders below do not count."""
    return folder.is_dir() and next(_images_in(folder), None) is not None


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key of natural order: numbers within names compare as numbers, and case does not matter."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(part), "") if part[:1].isdecimal() else (1, 0, part) for part in parts if part]


def _images_in(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.suffix.lower() in IMAGE_ENDINGS and path.is_file() and not path.name.startswith("."):
            yield path


def short_names(images: list[Path]) -> list[str]:
    """A unique name for each image, also where a file system ignores case: the stem where that suffices."""
    stems = Counter(path.stem.casefold() for path in images)
    return [path.stem if stems[path.stem.casefold()] == 1 else path.name for path in images]


def read_image_frame(path: Path, index: int, given: tuple[Camera, str] | None) -> tuple[Frame, Intrinsics]:
    """Read an image file as an upright frame, of a wide lens as its pinhole view.

    Args:
        index: the frame's index, and its time in seconds.
        given: the camera and where it comes from; None takes the focal length from EXIF or guesses it.

    Raises:
        ImageDecodeError: the image does not decode.
        CameraError: its size is not the given camera's.
    """
    image_rgb = read_image_rgb(path)
    height, width = image_rgb.shape[:2]
    if given is not None:
        camera, origin = given
        if (height, width) != (camera.height, camera.width):
            camera = fitted_camera(path, image_rgb.shape, camera, exif_orientation(path), [])
        found = Intrinsics(camera, origin, Certainty.GIVEN)
    else:
        found = intrinsics_of(width, height, exif_focal_35mm(path))
    frame = as_pinhole(Frame(index, float(index), image_rgb, found.camera))
    return frame, replace(found, camera=frame.camera)
