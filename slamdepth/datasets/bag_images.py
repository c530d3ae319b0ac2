# SPDX-License-Identifier: Apache-2.0
"""Image messages of ROS (``sensor_msgs/Image`` and ``CompressedImage``) as colours and as depth.

Encodings are those of ``sensor_msgs/image_encodings.hpp``; depth follows REP 118: 16UC1 in millimetres,
32FC1 in metres.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from slamdepth.errors import ImageDecodeError
from slamdepth.io import decode_image, decode_image_rgb, metres_of_raw
from slamdepth.typing import Bytes, Floats32

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

_CONVERSIONS = {
    "rgb8": (1, 3, None),
    "bgr8": (1, 3, "COLOR_BGR2RGB"),
    "8uc3": (1, 3, "COLOR_BGR2RGB"),
    "rgba8": (1, 4, "COLOR_RGBA2RGB"),
    "bgra8": (1, 4, "COLOR_BGRA2RGB"),
    "8uc4": (1, 4, "COLOR_BGRA2RGB"),
    "mono8": (1, 1, "COLOR_GRAY2RGB"),
    "8uc1": (1, 1, "COLOR_GRAY2RGB"),
    "mono16": (2, 1, "COLOR_GRAY2RGB"),
    "rgb16": (2, 3, None),
    "bgr16": (2, 3, "COLOR_BGR2RGB"),
    "yuv422": (1, 2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": (1, 2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (1, 2, "COLOR_YUV2RGB_YUY2"),
    "yuyv": (1, 2, "COLOR_YUV2RGB_YUY2"),
    **{f"bayer_{p}8": (1, 1, f"COLOR_Bayer{p.upper()}2RGB") for p in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{p}16": (2, 1, f"COLOR_Bayer{p.upper()}2RGB") for p in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Bytes of a value, values of a pixel, and OpenCV's conversion to RGB."""
_DEPTH = {"16uc1": np.uint16, "mono16": np.uint16, "32fc1": np.float32}
_PNG_START = b"\x89PNG"
_DEPTH_HEADER = struct.Struct("<iff")
"""Before the PNG of ``compressedDepth``: a format, and the two numbers that metres were quantised by."""
_MILLIMETRES = 1000.0


def encoding_of(message: Any) -> str:
    """The encoding of an image message in small letters; the format of a compressed one."""
    return str(getattr(message, "encoding", None) or getattr(message, "format", "")).lower()


def is_depth(encoding: str, topic: str) -> bool:
    """True where images of an encoding are depth rather than to be looked at."""
    if "compresseddepth" in encoding or encoding in ("16uc1", "32fc1"):
        return True
    return "depth" in topic.lower() and (encoding == "mono16" or encoding.startswith("16uc1"))


def is_colour(encoding: str) -> bool:
    """True where images of an encoding have colours."""
    return not encoding.startswith(("mono", "8uc1"))


def image_rgb(message: Any, what: str) -> Bytes:
    """The image of a message as ``(H, W, 3)`` uint8.

    Raises:
        ImageDecodeError: it does not decode, or its encoding is not known; ``what`` names it.
    """
    import cv2

    if not hasattr(message, "encoding"):
        return decode_image_rgb(_bytes(message), what)
    encoding = encoding_of(message)
    if encoding not in _CONVERSIONS:
        known = ", ".join(sorted(_CONVERSIONS))
        raise ImageDecodeError(
            f"{what}: images of encoding {encoding[:40]!r} are not read; known are {known}"
        )
    size, channels, conversion = _CONVERSIONS[encoding]
    pixels = _pixels(message, np.dtype(f"u{size}"), channels, what)
    if size == 2 and not encoding.startswith("bayer"):
        pixels = (pixels >> 8).astype(np.uint8)
    if conversion is not None:
        try:
            pixels = cv2.cvtColor(pixels, getattr(cv2, conversion))
        except cv2.error as error:
            raise ImageDecodeError(f"{what}: the image does not decode: {error.err}") from error
    if pixels.dtype == np.uint16:
        pixels = pixels >> 8
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def depth_m(message: Any, what: str) -> Floats32:
    """The depth of a message ``(H, W)`` in metres, 0 where unknown.

    Raises:
        ImageDecodeError: it does not decode, or is no depth.
    """
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        return _compressed_depth(_bytes(message), encoding, what)
    if encoding not in _DEPTH:
        raise ImageDecodeError(
            f"{what}: images of encoding {encoding[:40]!r} are no depth; needed is 16UC1 (millimetres) or "
            "32FC1 (metres)"
        )
    return metres_of_raw(_pixels(message, np.dtype(_DEPTH[encoding]), 1, what), _MILLIMETRES)


def _compressed_depth(data: bytes, encoding: str, what: str) -> Floats32:
    start = data.find(_PNG_START, 0, 64)
    if start < 0:
        raise ImageDecodeError(f"{what}: compressed depth of format {encoding[:40]!r} is not read, only PNG")
    raw = decode_image(data[start:], what)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise ImageDecodeError(
            f"{what}: a depth image has one channel of 16 bits, this is {raw.shape} {raw.dtype}"
        )
    if not encoding.startswith("32fc1"):
        return metres_of_raw(raw, _MILLIMETRES)
    if start < _DEPTH_HEADER.size:
        raise ImageDecodeError(f"{what}: compressed depth of floats without its header")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = np.where(raw > 0, a / (raw.astype(np.float32) - np.float32(b)), 0.0)
    return metres_of_raw(metres)


def _pixels(message: Any, dtype: Any, channels: int, what: str) -> Any:
    """``(H, W)`` or ``(H, W, channels)`` in this machine's byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8).ravel()
    row = width * channels * dtype.itemsize
    if height < 1 or width < 1 or step < row or len(data) < (height - 1) * step + row:
        raise ImageDecodeError(
            f"{what}: the image of {width}x{height} pixels, {step} bytes a row, has {len(data)} bytes"
        )
    if len(data) < height * step:
        data = np.concatenate([data, np.zeros(height * step - len(data), np.uint8)])
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    order = ">" if message.is_bigendian and dtype.itemsize > 1 else "<"
    pixels = rows.view(dtype.newbyteorder(order)).astype(dtype, copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels)


def _bytes(message: Any) -> bytes:
    return np.asarray(message.data, dtype=np.uint8).tobytes()
