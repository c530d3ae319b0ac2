# SPDX-License-Identifier: Apache-2.0
"""All lit textures of the synthetic room in one image with its mip levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.synth.shapes import Surface
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEVELS = 5
_GUTTER = 16  # texels of repeated border: one is left at the smallest level
_WIDTH = 4096
_EXPOSURE = 1.15


@dataclass(frozen=True)
class Place:
    """The rectangle of a surface's texture at level 0 without gutter, in texels."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class Atlas:
    """A texture atlas with all mip levels in one image.

    Attributes:
        image_rgb: ``(H, W, 3)`` uint8.
        offsets: ``(LEVELS, 2)`` x and y of each level's corner in ``image_rgb``.
        places: rectangle of each surface at level 0.
    """

    image_rgb: NDArray[np.uint8]
    offsets: Floats32
    places: list[Place]

    def sample(self, x: Floats32, y: Floats32, level: Floats32) -> Floats32:
        """Trilinear colours ``(N, 3)`` at level 0 texels ``x, y (N,)`` and fractional levels ``(N,)``."""
        level = np.clip(level, 0.0, LEVELS - 1.0)
        lower = np.minimum(level.astype(np.int32), LEVELS - 2)
        fine = self._bilinear(x, y, lower)
        coarse = self._bilinear(x, y, lower + 1)
        weight = (level - lower)[:, None]
        coarse -= fine
        coarse *= weight
        coarse += fine
        return coarse

    def _bilinear(self, x: Floats32, y: Floats32, level: NDArray[np.int32]) -> Floats32:
        import cv2

        count = len(x)
        row = 1024  # cv2.remap takes neither very long rows nor very many
        padded = -(-count // row) * row
        maps = np.zeros((2, padded), np.float32)
        shrink = np.ldexp(np.float32(1.0), -level).astype(np.float32)
        half = np.float32(0.5)
        maps[0, :count] = (x + half) * shrink - half + self.offsets[level, 0]
        maps[1, :count] = (y + half) * shrink - half + self.offsets[level, 1]
        out = cv2.remap(self.image_rgb, maps[0].reshape(-1, row), maps[1].reshape(-1, row), cv2.INTER_LINEAR)
        return out.reshape(-1, 3)[:count].astype(np.float32)


def build_atlas(surfaces: Sequence[Surface], light: Sequence[Floats32], texel_m: float, seed: int) -> Atlas:
    """Paint, light and pack every surface.

    Args:
        surfaces: what to paint.
        light: an irradiance map ``(rows, columns, 3)`` for each surface.
        texel_m: size of a texel where the surface asks for no other.
        seed: seed of the paints.
    """
    import cv2

    sizes = []
    for surface in surfaces:
        size = texel_m * surface.texel_scale
        along, down = (
            int(np.clip(round(length / size), 4, _WIDTH - 2 * _GUTTER)) for length in surface.size_m
        )
        sizes.append((along, down))
    places, height = _pack(sizes)

    base = np.zeros((height, _WIDTH, 3), np.uint8)
    for index, (surface, place, irradiance) in enumerate(zip(surfaces, places, light, strict=True)):
        rng = np.random.default_rng([seed, 4, index])
        texel = surface.size_m[0] / place.width
        texture = surface.paint(rng, place.height, place.width, texel)
        if surface.emission > 0:
            lit = texture * np.float32(surface.emission)
        else:
            shade = cv2.resize(irradiance, (place.width, place.height), interpolation=cv2.INTER_LINEAR)
            lit = _developed(texture, np.asarray(shade, np.float32))
        pixels = np.round(np.clip(lit, 0, 1) * 255).astype(np.uint8)
        g = _GUTTER
        base[place.y - g : place.y + place.height + g, place.x - g : place.x + place.width + g] = (
            cv2.copyMakeBorder(pixels, g, g, g, g, cv2.BORDER_REPLICATE)
        )

    image = np.zeros((height, _WIDTH + _WIDTH // 2, 3), np.uint8)
    image[:, :_WIDTH] = base
    offsets = np.zeros((LEVELS, 2), np.float32)
    level, y = base, 0
    for k in range(1, LEVELS):
        half = (level.shape[1] // 2, level.shape[0] // 2)
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint8)
        image[y : y + level.shape[0], _WIDTH : _WIDTH + level.shape[1]] = level
        offsets[k] = (_WIDTH, y)
        y += level.shape[0]
    return Atlas(image, offsets, places)


def _developed(albedo_srgb: Floats32, irradiance: Floats32) -> Floats32:
    """sRGB values 0 to 1 of albedo under light, after exposure and tone mapping as in a camera."""
    linear = np.power(np.clip(albedo_srgb, 0, 1), np.float32(2.2)) * irradiance * np.float32(_EXPOSURE)
    compressed = linear * (1 + linear / np.float32(4.0)) / (1 + linear)  # Reinhard, white at 2
    developed: Floats32 = np.power(np.clip(compressed * np.float32(1.25), 0, 1), np.float32(1 / 2.2))
    return developed.astype(np.float32)


def _pack(sizes: Sequence[tuple[int, int]]) -> tuple[list[Place], int]:
    """Rows of rectangles, tallest first; corners on multiples of the coarsest texel."""
    unit = 2 ** (LEVELS - 1)
    places: list[Place | None] = [None] * len(sizes)
    x = y = row_height = 0
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], -sizes[i][0], i)):
        width, height = sizes[index]
        full_width = -(-(width + 2 * _GUTTER) // unit) * unit
        if x + full_width > _WIDTH:
            x, y, row_height = 0, y + row_height, 0
        places[index] = Place(x + _GUTTER, y + _GUTTER, width, height)
        x += full_width
        row_height = max(row_height, -(-(height + 2 * _GUTTER) // unit) * unit)
    return [place for place in places if place is not None], y + row_height
