# SPDX-License-Identifier: Apache-2.0
"""Images and depth maps as bytes: JPEG for colour, 16-bit PNG for depth.

Sensor depth comes back to the bit. Predicted depth keeps the three digits of half precision.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_JPEG_QUALITY = 95  # moves a channel by half a grey value of 255 on average


@dataclass(frozen=True)
class Encoded:
    """An array as bytes.

    Attributes:
        decode: makes the array of ``data``.
    """

    data: bytes
    decode: Callable[[bytes], NDArray[Any]]

    def array(self) -> NDArray[Any]:
        """The array, as far as the encoding keeps it."""
        return self.decode(self.data)


def encode_image(image_rgb: NDArray[np.uint8]) -> Encoded:
    """Encode ``(H, W, 3)`` RGB as a JPEG of quality 95."""
    import cv2

    _, data = cv2.imencode(".jpg", image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return Encoded(data.tobytes(), decode_image)


def encode_sensor_depth(depth_m: NDArray[np.float32], units_per_m: float) -> Encoded:
    """Encode ``(H, W)`` float32 without loss.

    Args:
        units_per_m: of the sensor. Depth that is whole 16-bit numbers of this unit takes one PNG; any
            other takes one of twice the height, for the upper and the lower half of each float.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # such numbers differ below
        units = np.rint(depth_m * np.float32(units_per_m)).clip(0, 65535).astype(np.uint16)
    if np.array_equal(_metres(units, units_per_m), depth_m):
        return Encoded(_encode_png(units), partial(_decode_units, units_per_m=units_per_m))
    halves = np.ascontiguousarray(depth_m, np.float32).view(np.uint16).reshape(*depth_m.shape, 2)
    return Encoded(_encode_png(np.concatenate([halves[..., 0], halves[..., 1]])), _decode_float32)


def encode_half_precision(values: NDArray[np.floating]) -> Encoded:
    """Encode ``(H, W)`` rounded to float16, a relative error of at most 0.05 %; the dtype comes back."""
    words = np.ascontiguousarray(values, np.float16).view(np.uint16)
    return Encoded(_encode_png(words), partial(decode_half_precision, dtype=values.dtype))


def rounded_to_half_precision(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """What :func:`encode_half_precision` keeps of ``(H, W)``, in the same dtype."""
    return values.astype(np.float16).astype(values.dtype)


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """What :func:`encode_image` was given, ``(H, W, 3)`` RGB, as far as the JPEG keeps it.

    Raises:
        ValueError: it does not decode.
    """
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise ValueError("the image does not decode")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _decode_units(data: bytes, units_per_m: float) -> NDArray[np.float32]:
    return _metres(_decode_png(data), units_per_m)


def _decode_float32(data: bytes) -> NDArray[np.float32]:
    halves = np.split(_decode_png(data), 2)
    return np.asarray(np.stack(halves, axis=-1).view(np.float32)[..., 0], np.float32)


def decode_half_precision(data: bytes, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
    """What :func:`encode_half_precision` was given, as ``dtype``."""
    return _decode_png(data).view(np.float16).astype(dtype)


def _metres(units: NDArray[np.uint16], units_per_m: float) -> NDArray[np.float32]:
    """The same operations as ``slamdepth.io.read_depth_m``, so that the bits are the same."""
    return np.asarray(units.astype(np.float32) / np.float32(units_per_m), np.float32)


def _encode_png(words: NDArray[np.uint16]) -> bytes:
    import cv2

    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_FILTERED]
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # not in every OpenCV 4; without it, encoding takes twice as long
        settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    _, data = cv2.imencode(".png", words, settings)
    return data.tobytes()


def _decode_png(data: bytes) -> NDArray[np.uint16]:
    import cv2

    words = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert words is not None
    return np.asarray(words, np.uint16)
