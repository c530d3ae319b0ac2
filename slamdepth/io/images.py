# SPDX-License-Identifier: Apache-2.0
"""Colour and depth images in and out; what does not decode whole is an error, never a grey patch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import ImageDecodeError, OutputError
from slamdepth.io.image_end import is_cut_short
from slamdepth.io.text import replacing
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

MILLIMETRES_END_M = 65.535
"""The farthest depth a 16-bit image in millimetres can hold."""


def read_image_rgb(path: str | Path, *, upright: bool = True) -> NDArray[np.uint8]:
    """Read a colour image as ``(H, W, 3)`` uint8 RGB.

    Grey images get three equal channels.

    Args:
        upright: turn the image as its EXIF says; False leaves the pixels as they are stored.

    Raises:
        ImageDecodeError: the file is missing, empty, cut short or no image.
    """
    import cv2

    as_stored = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    image = _decode(Path(path), cv2.IMREAD_COLOR | as_stored)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def decode_image_rgb(data: bytes, what: str) -> NDArray[np.uint8]:
    """The image in the bytes of a file, such as JPEG or PNG, as ``(H, W, 3)`` uint8 RGB.

    Args:
        what: names it in messages.

    Raises:
        ImageDecodeError: they are none, or cut short, or no image.
    """
    import cv2

    return np.asarray(cv2.cvtColor(_decoded(data, cv2.IMREAD_COLOR, what), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def decode_image(data: bytes, what: str) -> NDArray[Any]:
    """The image in the bytes of a file as it is stored, such as 16 bits of grey; see
    :func:`decode_image_rgb`."""
    import cv2

    return _decoded(data, cv2.IMREAD_UNCHANGED, what)


def read_depth_raw(path: str | Path) -> NDArray[np.uint16]:
    """Read a 16-bit depth image as ``(H, W)`` uint16 in the units of its file.

    Raises:
        ImageDecodeError: the file is missing, empty, cut short, or no 16-bit image of one channel.
    """
    raw = read_depth_file(path)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise ImageDecodeError(
            f"{path}: a depth image has one channel of 16 bits, this is {raw.shape} {raw.dtype}"
        )
    return raw


def read_depth_file(path: str | Path) -> NDArray[Any]:
    """Read a depth image, or an array of NumPy (``.npy``), as it is stored.

    Raises:
        ImageDecodeError: the file is missing, empty, cut short, or does not decode.
    """
    import cv2

    path = Path(path)
    if path.suffix.lower() == ".npy":
        return _load_npy(path)
    if path.suffix.lower() == ".exr":  # OpenCV 4 reads this format only on request, version 5 not at all
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
        try:
            return _decode(path, cv2.IMREAD_UNCHANGED)
        except ImageDecodeError as error:
            raise ImageDecodeError(
                f"{error}; not every OpenCV reads EXR: write 32-bit TIFF or .npy"
            ) from error
    return _decode(path, cv2.IMREAD_UNCHANGED)


def read_depth_m(path: str | Path, depth_factor: float, *, unknown_raw: Sequence[int] = ()) -> Floats32:
    """Read a depth image as ``(H, W)`` float32 metres, 0 where unknown.

    Args:
        path: an image of one channel: integers of 16 bits or more in raw units, or floats in metres, whose
            negative and not finite values are unknown; PNG, TIFF, EXR (where OpenCV reads it) or ``.npy``.
        depth_factor: raw units per metre, for integers.
        unknown_raw: raw values that mean unknown, besides 0.

    Raises:
        ImageDecodeError: the file is missing, empty, cut short, or no depth image.
    """
    raw = read_depth_file(path)
    if raw.ndim != 2 or not (raw.dtype.kind == "f" or (raw.dtype.kind in "iu" and raw.dtype.itemsize >= 2)):
        raise ImageDecodeError(
            f"{path}: a depth image has one channel of 16 bits or of floats, this is {raw.shape} {raw.dtype}"
        )
    return metres_of_raw(raw, depth_factor, unknown_raw=unknown_raw)


def metres_of_raw(
    raw: NDArray[Any], depth_factor: float = 1.0, *, unknown_raw: Sequence[int] = ()
) -> Floats32:
    """Depth ``(H, W)`` in metres, float32, 0 where unknown, of values as a file holds them.

    Arguments as those of :func:`read_depth_m`, which reads the file.
    """
    depth_m: Floats32
    if raw.dtype.kind == "f":
        with np.errstate(over="ignore"):
            depth_m = raw.astype(np.float32)
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
        return depth_m
    depth_m = raw.astype(np.float32) / np.float32(depth_factor)
    for value in unknown_raw:
        depth_m[raw == value] = 0.0
    if raw.dtype.kind == "i":
        depth_m[raw < 0] = 0.0
    return depth_m


def write_png(path: str | Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write ``(H, W, 3)`` uint8 RGB or ``(H, W)`` uint8 or uint16 as PNG, whole or not at all.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    import cv2

    pixels = image[..., ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not done:
        raise OutputError(f"{path}: the image {image.shape} {image.dtype} cannot be encoded as PNG")
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())


def write_depth_mm(path: str | Path, depth_m: NDArray[np.floating]) -> int:
    """Write depth ``(H, W)`` in metres as a 16-bit PNG in whole millimetres, 0 where unknown.

    Returns:
        How many known pixels are 0 in the file because they lie beyond 65.535 m.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    millimetres = np.rint(np.where(known, depth_m, 0.0).astype(np.float64) * 1000.0)
    beyond = millimetres > 1000.0 * MILLIMETRES_END_M
    millimetres[beyond] = 0.0
    write_png(path, millimetres.astype(np.uint16))
    return int(beyond.sum())


def write_npy(path: str | Path, array: NDArray[Any]) -> None:
    """Write an array in NumPy's own format, whole or not at all.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def _load_npy(path: Path) -> NDArray[Any]:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ImageDecodeError(f"{path}: cannot be read: {reason}") from error
    return np.squeeze(array) if array.ndim == 3 else np.asarray(array)


def _decode(path: Path, flags: int) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        reason = getattr(error, "strerror", None) or error
        raise ImageDecodeError(f"{path}: cannot be read: {reason}") from error
    return _decoded(data, flags, str(path))


def _decoded(data: bytes, flags: int, what: str) -> NDArray[Any]:
    import cv2

    if not data:
        raise ImageDecodeError(f"{what}: the image is empty (0 bytes)")
    if is_cut_short(data):
        raise ImageDecodeError(f"{what}: the image is cut short ({len(data)} bytes)")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise ImageDecodeError(f"{what}: the image does not decode: {error.err}") from error
    if image is None:
        raise ImageDecodeError(f"{what}: the image does not decode")
    return image
