# SPDX-License-Identifier: Apache-2.0
"""The intrinsics of single images, and how certain they are: given, nominal or guessed."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets.quicktime import video_focal_35mm
from slamdepth.errors import CameraError
from slamdepth.types import Camera

_log = logging.getLogger(__name__)

GUESSED_VIEW_DEG = 60.0
"""Field of view across the longer side where nothing is known: between a phone's main camera
(65 to 70 degrees) and a depth camera's (57)."""

NOMINAL_SIGMA = 0.05
"""Relative deviation of a focal length that a photograph or a user names: rounded to whole millimetres or
degrees, and of the lens rather than of the image."""

_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_OF_A_VIDEO = math.hypot(1.0, 0.75)
"""Diagonal over longer side of the 4:3 sensor that a video is cut out of, over its whole width."""
_VIDEO_SIGMA = 0.1
"""Stabilisation cuts up to a fifth off a video's width, and the file does not say how much."""
_EXIF_IFD, _FOCAL_LENGTH_35MM = 0x8769, 0xA405


class Certainty(str, Enum):
    """Where a focal length comes from."""

    GIVEN = "given"
    NOMINAL = "nominal"
    GUESSED = "guessed"


@dataclass(frozen=True)
class CameraSource:
    """Where the intrinsics of a sequence come from.

    Attributes:
        certainty: GIVEN by a file or a known data set, NOMINAL from what the recording says of its lens, or
            GUESSED.
        how: the same as a user should read it, such as "camera.yaml next to the images".
        sigma_log_f: deviation of the logarithm of a NOMINAL focal length.
    """

    certainty: Certainty
    how: str
    sigma_log_f: float = NOMINAL_SIGMA


@dataclass(frozen=True)
class Intrinsics:
    """A camera, and how certain it is.

    Attributes:
        camera: the intrinsics in pixels.
        how: where they come from, as a user should read it.
        certainty: GIVEN by a file or a known data set, NOMINAL from what the camera wrote
            into the image, or GUESSED.
    """

    camera: Camera
    how: str
    certainty: Certainty


def find_camera_file(folder: Path, camera_file: Path | None) -> tuple[Camera, str] | None:
    """The camera in ``camera_file``, else in ``camera.yaml`` in ``folder``, and where it was; None
    where neither is there.

    Raises:
        CameraError: the file cannot be read or is malformed.
    """
    if camera_file is not None:
        return Camera.from_file(camera_file.expanduser()), f"the file {camera_file.name}"
    path = folder / CAMERA_FILE
    return (Camera.from_file(path), f"{CAMERA_FILE} next to the images") if path.is_file() else None


def intrinsics_of(width: int, height: int, focal_35mm: float | None = None) -> Intrinsics:
    """Intrinsics of an image of ``width`` x ``height`` pixels without a camera file.

    Args:
        focal_35mm: the focal length in millimetres a lens with the same view would have on a
            36 x 24 mm film, by the diagonal (CIPA DCG-001), from the image's EXIF.
    """
    if focal_35mm is not None:
        focal_px = focal_35mm * math.hypot(width, height) / _FULL_FRAME_DIAGONAL_MM
        how = (
            f"EXIF: as {focal_35mm:g} mm on 35 mm film, {_px(focal_px, width, height)}; wrong if the image "
            "was cropped"
        )
        return Intrinsics(centred_camera(width, height, focal_px), how, Certainty.NOMINAL)
    camera = camera_of_view(width, height, GUESSED_VIEW_DEG)
    how = f"a guess: {GUESSED_VIEW_DEG:g} degrees across the longer side, so {_px(camera.fx, width, height)}"
    return Intrinsics(camera, how, Certainty.GUESSED)


def intrinsics_of_images(path: Path, width: int, height: int) -> tuple[Camera, CameraSource]:
    """The camera of images like ``path``, of this upright size, without a camera file: by EXIF or a guess."""
    return _named(intrinsics_of(width, height, exif_focal_35mm(path)))


def intrinsics_of_video(path: Path, width: int, height: int) -> tuple[Camera, CameraSource]:
    """The camera of a video of this upright size without a camera file: by its metadata or a guess."""
    focal_35mm = video_focal_35mm(path)
    if focal_35mm is None:
        return _named(intrinsics_of(width, height))
    focal_px = focal_35mm * _OF_A_VIDEO * max(width, height) / _FULL_FRAME_DIAGONAL_MM
    how = (
        f"the video's metadata: as {focal_35mm:g} mm on 35 mm film, {_px(focal_px, width, height)} if the "
        "whole width of the sensor was used"
    )
    camera = centred_camera(width, height, focal_px)
    return camera, CameraSource(Certainty.NOMINAL, how, _VIDEO_SIGMA)


def tell_guess(name: str, source: CameraSource) -> None:
    """Log that the intrinsics of a sequence of this name are a guess, where they are and will be used."""
    if source.certainty is Certainty.GUESSED:
        _log.warning("%s: the intrinsics are unknown; taken is %s", name, source.how)


def _px(focal_px: float, width: int, height: int) -> str:
    """A focal length with the size of its pixels: frames may be tracked at another one."""
    return f"{focal_px:.1f} px at {width}x{height}"


def _named(found: Intrinsics) -> tuple[Camera, CameraSource]:
    return found.camera, CameraSource(found.certainty, found.how)


def centred_camera(width: int, height: int, focal_px: float) -> Camera:
    """A camera without distortion whose centre is the middle of the image."""
    return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def camera_of_view(width: int, height: int, view_deg: float) -> Camera:
    """A camera that sees ``view_deg`` degrees across the longer side of its image.

    Raises:
        CameraError: no image of a pinhole camera has such a view.
    """
    if not 1.0 <= view_deg <= 170.0:
        raise CameraError(
            f"a field of view of {view_deg:g} degrees: possible are from 1 to 170, across the longer side"
        )
    return centred_camera(width, height, max(width, height) / (2.0 * math.tan(math.radians(view_deg) / 2.0)))


def exif_focal_35mm(path: Path) -> float | None:
    """``FocalLengthIn35mmFilm`` of an image file in millimetres; None where it has none."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            value = image.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_LENGTH_35MM)
        focal_mm = float(value) if value is not None else 0.0
    except Exception:  # damaged EXIF may raise anything, and counts as none
        return None
    return focal_mm if 0 < focal_mm < 10_000 else None
