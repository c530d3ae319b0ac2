# SPDX-License-Identifier: Apache-2.0
"""Images stored on their side: every image is turned upright, and its camera and depth with it.

Orientations are those of EXIF, 1 to 8: 1 upright, 3 upside down, 6 to be turned clockwise by 90 degrees,
8 counterclockwise; 2, 4, 5 and 7 are mirrored.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from slamdepth.errors import CameraError
from slamdepth.types import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

UPRIGHT = 1
OF_ROTATION_DEG = {0: UPRIGHT, 90: 6, 180: 3, 270: 8}
"""EXIF's orientation for the clockwise rotation of a video."""

_EXIF_ORIENTATION = 0x0112
_ON_ITS_SIDE = (5, 6, 7, 8)
_AXES = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}
"""Rows of the matrix from stored x, y to upright x, y."""

_Scalar = TypeVar("_Scalar", bound=np.generic)


def exif_orientation(path: Path, notes: list[str] | None = None) -> int:
    """The orientation of an image file, 1 where it has none.

    Args:
        notes: takes a line where it is another than upright.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            value = int(image.getexif().get(_EXIF_ORIENTATION, UPRIGHT))
    except Exception:  # damaged EXIF may raise anything, and counts as none
        return UPRIGHT
    if value not in _AXES or value == UPRIGHT:
        return UPRIGHT
    if notes is not None:
        notes.append(f"images are turned upright, as their EXIF says ({path.name}: orientation {value})")
    return value


def turned_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of upright images, from that of the pixels as they are stored."""
    (a, b), (c, d) = _AXES[orientation]
    k1, k2, p1, p2, *others = camera.distortion
    # Tangential distortion (p2, p1) turns like a vector.
    distortion = (k1, k2, c * p2 + d * p1, a * p2 + b * p1, *others)
    width, height = (camera.width, camera.height) if a else (camera.height, camera.width)
    u = a * camera.cx + b * camera.cy
    v = c * camera.cx + d * camera.cy
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx if a else camera.fy,
        fy=camera.fy if a else camera.fx,
        cx=u if a + b > 0 else width - 1 + u,
        cy=v if c + d > 0 else height - 1 + v,
        distortion=distortion,
        lens=None if camera.lens is None else camera.lens.turned(_AXES[orientation]),
    )


def turned_image(image: NDArray[_Scalar], orientation: int) -> NDArray[_Scalar]:
    """The upright image ``(H, W, ...)`` of one as it is stored."""
    (a, _), (c, d) = _AXES[orientation]
    upright = image if a else image.swapaxes(0, 1)
    first = _AXES[orientation][0]
    if sum(first) < 0:
        upright = upright[:, ::-1]
    if c + d < 0:
        upright = upright[::-1]
    return np.ascontiguousarray(upright)


def turned_rotation(orientation: int) -> NDArray[np.float64]:
    """``T_upright_stored (4, 4)``, from the frame of a camera whose pixels are stored so to that of upright
    ones; of orientations that are not mirrored."""
    T = np.eye(4)
    T[:2, :2] = _AXES[orientation]
    return T


def fitted_camera(
    path: Path, shape: tuple[int, ...], camera: Camera, orientation: int, notes: list[str]
) -> Camera:
    """``camera``, or it turned, whichever fits upright images of ``shape`` (H, W, ...).

    Args:
        path: of an image, or of the video, for messages.
        orientation: of the stored pixels.
        notes: takes a line where something was turned.

    Raises:
        CameraError: neither fits.
    """
    size = (camera.height, camera.width)
    if shape[:2] != size and shape[1::-1] == size and orientation in _ON_ITS_SIDE:
        notes.append(
            f"the camera of {camera.width}x{camera.height} pixels is that of the images as they are stored, "
            "and is turned with them"
        )
        return turned_camera(camera, orientation)
    check_size(path, shape, camera)
    return camera


def check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    """Raise CameraError where an image of ``shape`` (H, W, ...) is not the camera's."""
    if shape[:2] == (camera.height, camera.width):
        return
    hint = ""
    if shape[1::-1] == (camera.height, camera.width):
        hint = "; one lies on its side: turn the images, or swap width, fx, cx with height, fy, cy"
    elif shape[0] * camera.width == shape[1] * camera.height:
        factor = shape[1] / camera.width
        hint = f"; if the images were resized, multiply fx, fy, cx, cy by {factor:.6g} and write their size"
    raise CameraError(
        f"{path}: the image is {shape[1]}x{shape[0]}, the camera says {camera.width}x{camera.height}{hint}"
    )
