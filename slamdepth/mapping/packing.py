# SPDX-License-Identifier: Apache-2.0
"""Images and depth maps as few bytes.

Depth loses nothing that its source had: a sensor's is whole numbers of some unit, a
network's is good for two digits and keeps the three of half precision. Neighbours are
alike, so what is stored is how each differs from what its neighbours foretell.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_JPEG_QUALITY = 95  # moves a channel by half a grey value of 255 on average


class Numbers(Enum):
    """How the numbers of a depth map are written."""

    UNITS = "whole numbers of a unit"
    HALF = "half precision"
    AS_THEY_ARE = "single precision"


@dataclass(frozen=True)
class PackedMap:
    """A depth map ``(H, W)`` as bytes.

    Attributes:
        per_m: units per metre, where the numbers are UNITS.
        dtype: of the map it was and will be.
    """

    data: bytes
    numbers: Numbers
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    per_m: float = 1.0

    def unpacked(self) -> NDArray[Any]:
        """The map, ``(H, W)`` of ``dtype``."""
        height, width = self.shape
        if self.numbers is Numbers.AS_THEY_ARE:
            halves = _unpacked_words(self.data, (2 * height, width))
            words = np.stack([halves[:height], halves[height:]], axis=-1)
            return np.ascontiguousarray(words).view(np.float32)[..., 0]
        words = _unpacked_words(self.data, self.shape)
        if self.numbers is Numbers.HALF:
            return words.view(np.float16).astype(self.dtype)
        return _metres(words, self.per_m)


def pack_measured(depth_m: NDArray[np.float32], per_m: float) -> PackedMap:
    """Pack ``(H, W)`` float32 bit for bit: as whole numbers of ``1 / per_m`` metres where it is
    made of such, as a 16-bit depth image is."""
    with np.errstate(invalid="ignore", over="ignore"):  # such numbers are not equal below
        words = np.rint(depth_m * np.float32(per_m)).clip(0, 65535).astype(np.uint16)
    if np.array_equal(_metres(words, per_m), depth_m):
        return PackedMap(_packed_words(words), Numbers.UNITS, _shape(depth_m), depth_m.dtype, per_m)
    halves = np.ascontiguousarray(depth_m, np.float32).view(np.uint16).reshape(*depth_m.shape, 2)
    words = np.concatenate([halves[..., 0], halves[..., 1]])
    return PackedMap(_packed_words(words), Numbers.AS_THEY_ARE, _shape(depth_m), np.dtype(np.float32))


def pack_predicted(values: NDArray[np.floating]) -> PackedMap:
    """Pack ``(H, W)`` in half precision, which is 0.05 % at most off, and nothing for float16."""
    words = np.ascontiguousarray(values, np.float16).view(np.uint16)
    return PackedMap(_packed_words(words), Numbers.HALF, _shape(values), values.dtype)


def pack_image(image_rgb: NDArray[np.uint8]) -> bytes:
    """``(H, W, 3)`` as a JPEG that an eye cannot tell from it."""
    import cv2

    _, data = cv2.imencode(".jpg", image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return bytes(data)


def unpack_image(data: bytes) -> NDArray[np.uint8]:
    """``(H, W, 3)`` RGB of :func:`pack_image`."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _shape(array: NDArray[Any]) -> tuple[int, int]:
    height, width = array.shape
    return height, width


def _metres(words: NDArray[np.uint16], per_m: float) -> NDArray[np.float32]:
    """As ``slamdepth.io.read_depth_m`` makes them, to the bit."""
    return words.astype(np.float32) / np.float32(per_m)


def _packed_words(words: NDArray[np.uint16]) -> bytes:
    """Second differences, small ones of either sign first, high bytes apart from low ones."""
    across = words.copy()
    across[:, 1:] -= words[:, :-1]
    rest = across.copy()
    rest[1:] -= across[:-1]
    signed = rest.view(np.int16)
    folded = ((signed << 1) ^ (signed >> 15)).view(np.uint16)
    low, high = (folded & 0xFF).astype(np.uint8), (folded >> 8).astype(np.uint8)
    deflate = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    return deflate.compress(low.tobytes() + high.tobytes()) + deflate.flush()


def _unpacked_words(data: bytes, shape: tuple[int, int]) -> NDArray[np.uint16]:
    low, high = np.frombuffer(zlib.decompress(data), np.uint8).reshape(2, *shape).astype(np.uint16)
    folded = low | (high << 8)
    rest = (folded >> 1) ^ (-(folded & 1).astype(np.int16)).view(np.uint16)
    across = np.cumsum(rest, axis=0, dtype=np.uint16)
    return np.cumsum(across, axis=1, dtype=np.uint16)
