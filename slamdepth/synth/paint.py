# SPDX-License-Identifier: Apache-2.0
"""Procedural textures of the synthetic room, with detail at several scales.

Most functions return a :data:`~slamdepth.synth.shapes.Paint`. Lengths are in metres, colours sRGB 0 to 1.
Detail is laid out in metres, so a coarser atlas shows the same pattern.
"""

from __future__ import annotations

import numpy as np

from slamdepth.synth.shapes import Paint
from slamdepth.typing import Floats32

Colour = tuple[float, float, float]


def fractal(
    rng: np.random.Generator,
    height: int,
    width: int,
    texel_m: float,
    *,
    largest_m: float = 0.5,
    octaves: int = 7,
    gain: float = 0.7,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> Floats32:
    """Value noise ``(height, width)`` of about unit deviation; ``stretch`` is (down, along)."""
    import cv2

    total = np.zeros((height, width), np.float32)
    power = 0.0
    for octave in range(octaves):
        wave_m = largest_m / 2.0**octave
        if wave_m * min(stretch) < 2.0 * texel_m and octave > 0:
            break
        rows = max(2, round(height * texel_m / (wave_m * stretch[0]))) + 3
        columns = max(2, round(width * texel_m / (wave_m * stretch[1]))) + 3
        grid = rng.standard_normal((min(rows, height + 3), min(columns, width + 3)), dtype=np.float32)
        weight = gain**octave
        total += weight * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        power += weight * weight * 0.45
    return np.asarray(total / np.float32(np.sqrt(power)))


def flat(height: int, width: int, colour: Colour) -> Floats32:
    """An image of one colour."""
    return np.full((height, width, 3), colour, np.float32)


def shaded(base: Floats32, amount: Floats32) -> Floats32:
    """``base`` made lighter or darker by relative ``amount (height, width)``."""
    return np.clip(base * (1.0 + amount[..., None]), 0.0, 1.0).astype(np.float32)


def fill(image: Floats32, x0: float, y0: float, x1: float, y1: float, colour: Colour | Floats32) -> None:
    """Fill a rectangle given in texels, clipped to the image."""
    rows = slice(max(0, round(y0)), max(0, round(y1)))
    columns = slice(max(0, round(x0)), max(0, round(x1)))
    image[rows, columns] = colour


def plain(colour: Colour, *, contrast: float = 0.03, largest_m: float = 0.4) -> Paint:
    """A painted or moulded surface with faint mottling."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        noise = fractal(rng, height, width, texel_m, largest_m=largest_m)
        return shaded(flat(height, width, colour), contrast * noise)

    return paint


def muted(paint_: Paint, contrast: float) -> Paint:
    """``paint_`` with its contrast about the mean colour scaled by ``contrast``."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        full = paint_(rng, height, width, texel_m)
        mean = full.mean(axis=(0, 1), keepdims=True)
        return np.asarray(mean + contrast * (full - mean), np.float32)

    return paint


def plaster(colour: Colour) -> Paint:
    """A rough painted wall with stains, trowel marks and specks."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        stains = fractal(rng, height, width, texel_m, largest_m=0.9, octaves=3)
        grain = fractal(rng, height, width, texel_m, largest_m=0.05, octaves=4, gain=0.85)
        trowel = fractal(rng, height, width, texel_m, largest_m=0.12, octaves=4, stretch=(0.5, 2.5))
        image = shaded(flat(height, width, colour), 0.025 * stains + 0.035 * grain + 0.02 * trowel)
        for _ in range(round(45 * height * width * texel_m**2)):
            size = rng.uniform(0.003, 0.011) / texel_m
            x, y = rng.uniform(0, width), rng.uniform(0, height)
            rows = slice(max(0, int(y)), int(y + size) + 1)
            columns = slice(max(0, int(x)), int(x + size * rng.uniform(0.6, 2.0)) + 1)
            image[rows, columns] *= np.float32(rng.uniform(0.72, 0.92))
        return image

    return paint


def wallpaper(ground: Colour, figure: Colour) -> Paint:
    """Stripes and irregular sprigs, each slightly different."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        import cv2

        image = flat(height, width, ground)
        x_m = np.arange(width) * texel_m
        stripe = 0.03 * np.sign(np.sin(2 * np.pi * x_m / 0.24))[None, :]
        image = shaded(image, np.broadcast_to(stripe, (height, width)).astype(np.float32))
        for row, y_m in enumerate(np.arange(0.08, height * texel_m, 0.17)):
            for x0_m in np.arange(0.06 + 0.12 * (row % 2), width * texel_m, 0.24):
                centre = np.array([x0_m, y_m]) + rng.uniform(-0.008, 0.008, 2)
                heading = rng.uniform(0, np.pi)
                for petal in range(rng.integers(3, 6)):
                    a = heading + petal * 1.25
                    tip = centre + 0.026 * np.array([np.cos(a), np.sin(a)])
                    axes = np.array([rng.uniform(0.010, 0.020), rng.uniform(0.005, 0.009)]) / texel_m
                    shade = np.array(figure) * rng.uniform(0.8, 1.15)
                    cv2.ellipse(
                        image, tuple(np.round(tip / texel_m).astype(int).tolist()),
                        tuple(np.maximum(1, np.round(axes)).astype(int).tolist()),
                        float(np.degrees(a)), 0, 360, shade.tolist(), -1, cv2.LINE_8,
                    )  # fmt: skip
        return shaded(image, 0.03 * fractal(rng, height, width, texel_m, largest_m=0.6))

    return paint


def brick(colour: Colour = (0.62, 0.36, 0.28), mortar: Colour = (0.72, 0.69, 0.65)) -> Paint:
    """Courses of bricks, each of its own shade."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = shaded(
            flat(height, width, mortar), 0.08 * fractal(rng, height, width, texel_m, largest_m=0.02)
        )
        grain = fractal(rng, height, width, texel_m, largest_m=0.08, octaves=5, gain=0.85)
        joint = 0.011
        for row, y in enumerate(np.arange(0.0, height * texel_m, 0.075)):
            for x in np.arange(-0.125 * (row % 2) - 0.01, width * texel_m, 0.25):
                shade = np.array(colour) * rng.uniform(0.7, 1.25) + rng.uniform(-0.03, 0.03, 3)
                j = rng.uniform(-0.002, 0.002, 4)
                fill(
                    image, (x + j[0]) / texel_m, (y + j[1]) / texel_m,
                    (x + 0.25 - joint + j[2]) / texel_m, (y + 0.075 - joint + j[3]) / texel_m,
                    np.clip(shade, 0, 1).astype(np.float32),
                )  # fmt: skip
        return shaded(image, 0.10 * grain)

    return paint


def wood(colour: Colour, *, along: bool = True, plank_m: float = 0.0, plank_length_m: float = 0.9) -> Paint:
    """Grain along a row (or down a column), optionally laid in staggered planks."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        h, w = (height, width) if along else (width, height)
        v_m = (np.arange(h, dtype=np.float32) * texel_m)[:, None]
        bend = fractal(rng, h, w, texel_m, largest_m=0.35, octaves=3, stretch=(0.4, 3.0))
        fibre = fractal(rng, h, w, texel_m, largest_m=0.03, octaves=4, gain=0.9, stretch=(0.35, 6.0))
        offset = np.zeros((h, w), np.float32)
        tone = np.zeros((h, w), np.float32)
        seam = np.zeros((h, w), np.float32)
        if plank_m > 0:
            for y in np.arange(0.0, h * texel_m, plank_m):
                start = -rng.uniform(0.0, plank_length_m)
                while start < w * texel_m:
                    rows = slice(round(y / texel_m), round((y + plank_m) / texel_m))
                    columns = slice(max(0, round(start / texel_m)), round((start + plank_length_m) / texel_m))
                    offset[rows, columns] = rng.uniform(0.0, 10.0)
                    tone[rows, columns] = rng.uniform(-0.16, 0.14)
                    seam[rows, columns][: max(1, round(0.002 / texel_m))] = 1.0
                    seam[rows, columns][:, : max(1, round(0.002 / texel_m))] = 1.0
                    start += plank_length_m * rng.uniform(0.6, 1.1)
        rings = np.sin(2 * np.pi * ((v_m + offset) / 0.028 + 1.6 * bend))
        image = shaded(flat(h, w, colour), 0.07 * rings + 0.09 * fibre + 0.03 * bend + tone - 0.55 * seam)
        return image if along else np.ascontiguousarray(image.transpose(1, 0, 2))

    return paint


def fabric(colour: Colour, *, stripe: Colour | None = None) -> Paint:
    """Woven cloth, mottled; optionally striped."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = flat(height, width, colour)
        if stripe is not None:
            x = 0.0
            while x < width * texel_m:
                band = rng.uniform(0.008, 0.04)
                fill(image, x / texel_m, 0, (x + band) / texel_m, height, stripe)
                x += band + rng.uniform(0.015, 0.06)
        weave = fractal(rng, height, width, texel_m, largest_m=0.016, octaves=3, gain=0.95)
        fold = fractal(rng, height, width, texel_m, largest_m=0.3, octaves=4)
        return shaded(image, 0.09 * weave + 0.06 * fold)

    return paint


def rug(colours: list[Colour]) -> Paint:
    """A carpet of nested borders, diamonds and knots."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        y_m = (np.arange(height, dtype=np.float32) * texel_m)[:, None]
        x_m = (np.arange(width, dtype=np.float32) * texel_m)[None, :]
        edge = np.minimum(np.minimum(x_m, width * texel_m - x_m), np.minimum(y_m, height * texel_m - y_m))
        diamond = (np.abs((x_m % 0.28) - 0.14) + np.abs((y_m % 0.28) - 0.14)) / 0.14
        cell = (np.floor(x_m / 0.28) * 7 + np.floor(y_m / 0.28) * 13).astype(int)
        pick = rng.integers(0, len(colours), 997)[cell % 997]
        index = np.where(diamond < 0.45, pick, np.where(diamond < 0.75, 0, 1))
        border = np.floor(edge / 0.035).astype(int)
        index = np.where(border < 5, np.array([2, 0, 3, 1, 2])[np.minimum(border, 4)] % len(colours), index)
        tooth = (border == 2) & (((x_m + y_m) % 0.05) < 0.025)
        index = np.where(tooth, 0, index)
        image = np.array(colours, np.float32)[index]
        knots = fractal(rng, height, width, texel_m, largest_m=0.02, octaves=3, gain=0.95)
        wear = fractal(rng, height, width, texel_m, largest_m=0.5, octaves=4)
        return shaded(image, 0.13 * knots + 0.07 * wear)

    return paint


def checker(first: Colour, second: Colour, size_m: float) -> Paint:
    """A checkerboard with fields of slightly different shades."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        row = (np.arange(height) * texel_m / size_m).astype(int)[:, None]
        column = (np.arange(width) * texel_m / size_m).astype(int)[None, :]
        tone = rng.uniform(0.8, 1.1, 1009)[(row * 31 + column * 17) % 1009][..., None]
        image = np.where(((row + column) % 2)[..., None] == 0, np.array(first), np.array(second)) * tone
        noise = fractal(rng, height, width, texel_m, largest_m=0.1)
        return shaded(image.astype(np.float32), 0.05 * noise)

    return paint


def tiles(colour: Colour, grout: Colour, across: int, down: int) -> Paint:
    """``across`` by ``down`` tiles, each exactly like the others."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        rows, columns = max(2, round(height / down)), max(2, round(width / across))
        vein = fractal(rng, rows, columns, texel_m, largest_m=0.25, octaves=5, stretch=(0.6, 1.6))
        grain = fractal(rng, rows, columns, texel_m, largest_m=0.03, octaves=3, gain=0.9)
        tile = shaded(flat(rows, columns, colour), 0.10 * vein + 0.05 * grain)
        joint = max(1, round(0.004 / texel_m))
        tile[:joint] = tile[-joint:] = tile[:, :joint] = tile[:, -joint:] = grout
        row = ((np.arange(height) + 0.5) * down / height % 1.0 * rows).astype(int)
        column = ((np.arange(width) + 0.5) * across / width % 1.0 * columns).astype(int)
        return np.ascontiguousarray(tile[row][:, column])

    return paint
