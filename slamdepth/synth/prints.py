# SPDX-License-Identifier: Apache-2.0
"""Procedural prints of the synthetic room: posters, books, screens, a view for the window."""

from __future__ import annotations

import numpy as np

from slamdepth.synth.paint import Colour, fill, flat, fractal, shaded
from slamdepth.synth.shapes import Paint
from slamdepth.typing import Floats32

_INKS: list[Colour] = [
    (0.62, 0.26, 0.22), (0.26, 0.37, 0.50), (0.78, 0.63, 0.34), (0.32, 0.44, 0.36),
    (0.24, 0.24, 0.27), (0.72, 0.48, 0.34), (0.44, 0.36, 0.46), (0.84, 0.82, 0.76),
]  # fmt: skip


def cardboard() -> Paint:
    """A carton with tape, a label and print."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        grain = fractal(rng, height, width, texel_m, largest_m=0.3, stretch=(2.0, 0.7))
        image = shaded(flat(height, width, (0.68, 0.53, 0.37)), 0.07 * grain)
        fill(image, width * 0.46, 0, width * 0.54, height, (0.78, 0.67, 0.50))
        x, y = width * rng.uniform(0.05, 0.15), height * rng.uniform(0.15, 0.4)
        write(
            rng, image, texel_m, (x, y, width * 0.42, height * 0.8), (0.9, 0.9, 0.87), (0.1, 0.1, 0.12), 0.012
        )
        write(
            rng,
            image,
            texel_m,
            (width * 0.6, height * 0.1, width * 0.95, height * 0.5),
            None,
            (0.25, 0.18, 0.12),
            0.03,
        )
        return image

    return paint


def write(
    rng: np.random.Generator,
    image: Floats32,
    texel_m: float,
    area: tuple[float, float, float, float],
    paper: Colour | None,
    ink: Colour,
    line_m: float,
) -> None:
    """Draw lines of random words into ``area`` (x0, y0, x1, y1 in texels) of ``image``, in place."""
    x0, y0, x1, y1 = area
    if paper is not None:
        fill(image, x0, y0, x1, y1, paper)
    line, glyph = line_m / texel_m, 0.45 * line_m / texel_m
    if line < 1.0:
        return
    y = y0 + 0.6 * line
    while y + line < y1:
        x, end = x0 + line, x1 - line * rng.uniform(0.8, 5.0)
        while x < end:
            for _ in range(rng.integers(2, 9)):
                if x >= end:
                    break
                tall = rng.random()
                top = y + (0.0 if tall < 0.3 else 0.22 * line)
                foot = y + (0.62 if tall < 0.85 else 0.82) * line
                stroke = max(1.0, 0.3 * glyph)
                fill(image, x, top, x + stroke, foot, ink)
                if rng.random() < 0.6:
                    fill(
                        image,
                        x,
                        top if rng.random() < 0.5 else foot - stroke,
                        x + 0.8 * glyph,
                        (top if rng.random() < 0.5 else foot - stroke) + stroke,
                        ink,
                    )
                if rng.random() < 0.5:
                    fill(image, x + 0.6 * glyph, y + 0.22 * line, x + 0.6 * glyph + stroke, foot, ink)
                x += glyph * rng.uniform(0.9, 1.3)
            x += glyph * 0.9
        y += line * (1.0 if rng.random() < 0.88 else 2.0)


def pick_ink(rng: np.random.Generator) -> Colour:
    """One of the print colours."""
    return _INKS[int(rng.integers(len(_INKS)))]


def poster() -> Paint:
    """Abstract shapes over a gradient, with a title and small print."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        import cv2

        t = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
        image = np.broadcast_to(
            (1 - t) * np.array(pick_ink(rng), np.float32) + t * np.array(pick_ink(rng), np.float32),
            (height, width, 3),
        ).copy()
        for k in range(int(rng.integers(10, 16))):
            size = min(height, width) * (0.32 if k < 4 else rng.uniform(0.04, 0.16))
            x, y = int(rng.uniform(0, width)), int(rng.uniform(0, 0.8 * height))
            colour = (np.array(pick_ink(rng)) * rng.uniform(0.8, 1.1)).tolist()
            if rng.random() < 0.5:
                cv2.circle(image, (x, y), max(1, int(size)), colour, -1)
                cv2.circle(image, (x, y), max(1, int(size * 0.55)), pick_ink(rng), -1)
            else:
                corners = np.array([x, y]) + size * rng.uniform(-1.0, 1.0, (int(rng.integers(3, 6)), 2))
                cv2.fillConvexPoly(image, cv2.convexHull(np.round(corners).astype(np.int32)), colour)
        margin = 0.08 * width
        paper = (0.93, 0.92, 0.88)
        write(
            rng,
            image,
            texel_m,
            (margin, 0.80 * height, width - margin, 0.88 * height),
            paper,
            (0.1, 0.1, 0.1),
            0.045,
        )
        write(
            rng,
            image,
            texel_m,
            (margin, 0.88 * height, width - margin, 0.96 * height),
            paper,
            (0.2, 0.2, 0.2),
            0.014,
        )
        return shaded(image, 0.05 * fractal(rng, height, width, texel_m, largest_m=0.15))

    return paint


def landscape() -> Paint:
    """Hills under a cloudy sky."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        scale = texel_m / max(height * texel_m, 1e-3)
        cloud = fractal(rng, height, width, scale, largest_m=0.5, octaves=7)
        t = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
        sky = np.array([0.50, 0.66, 0.85], np.float32) + (0.35 * t + 0.10 * np.clip(cloud, -1, 2))[..., None]
        image = np.clip(sky, 0, 1).astype(np.float32)
        grass = fractal(rng, height, width, scale, largest_m=0.1, octaves=6, gain=0.85)
        for k in range(4):
            ridge = fractal(rng, 1, width, scale, largest_m=0.6, octaves=6, gain=0.5)[0]
            top = 0.42 + 0.15 * k + 0.05 * ridge
            near = k / 3.0
            hill = np.array([0.35 - 0.1 * near, 0.47 - 0.1 * near, 0.45 - 0.28 * near], np.float32)
            image = np.where(
                (t > top[None, :])[..., None], hill * (1 + (0.05 + 0.15 * near) * grass[..., None]), image
            )
        return np.clip(image, 0, 1).astype(np.float32)

    return paint


def page() -> Paint:
    """A sheet of text."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = flat(height, width, (0.90, 0.90, 0.87))
        write(
            rng,
            image,
            texel_m,
            (0.04 * width, 0.04 * height, 0.96 * width, 0.96 * height),
            None,
            (0.15, 0.15, 0.18),
            0.014,
        )
        return image

    return paint


def book(colour: Colour) -> Paint:
    """A spine: bands, a title running down, wear."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = flat(height, width, colour)
        ink = (0.92, 0.88, 0.72) if sum(colour) < 1.5 else (0.15, 0.13, 0.12)
        for y in (0.06, 0.10, rng.uniform(0.8, 0.93)):
            fill(image, 0, y * height, width, (y + rng.uniform(0.01, 0.03)) * height, ink)
        turned = np.ascontiguousarray(image.transpose(1, 0, 2))
        write(
            rng,
            turned,
            texel_m,
            (0.14 * height, 0, 0.78 * height, width),
            None,
            ink,
            max(0.6 * width * texel_m, 4 * texel_m),
        )
        wear = fractal(rng, width, height, texel_m, largest_m=0.05)
        return np.ascontiguousarray(shaded(turned, 0.06 * wear).transpose(1, 0, 2))

    return paint


def screen() -> Paint:
    """A desktop with windows of code and a bar."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image: Floats32 = landscape()(rng, height, width, texel_m) * np.float32(0.6)
        for x0, y0, x1, y1, paper, ink in (
            (0.04, 0.07, 0.50, 0.86, (0.11, 0.13, 0.17), (0.55, 0.75, 0.60)),
            (0.44, 0.20, 0.95, 0.92, (0.92, 0.93, 0.94), (0.15, 0.20, 0.35)),
        ):
            area = (x0 * width, y0 * height, x1 * width, y1 * height)
            fill(image, area[0], area[1] - 0.03 * height, area[2], area[1], (0.35, 0.38, 0.45))
            write(rng, image, texel_m, area, paper, ink, 0.013)
        fill(image, 0, 0.96 * height, width, height, (0.15, 0.16, 0.2))
        return image

    return paint


def keyboard() -> Paint:
    """Rows of keys."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = flat(height, width, (0.10, 0.10, 0.11))
        pitch = 0.019 / texel_m
        for row in range(int(height / pitch)):
            x = 0.3 * pitch
            while x < width - pitch:
                size = pitch * (1.0 if rng.random() < 0.85 else 1.6)
                shade = float(rng.uniform(0.22, 0.34))
                y = (row + 0.3) * pitch
                fill(image, x, y, x + 0.8 * size, y + 0.75 * pitch, (shade, shade, shade))
                fill(
                    image,
                    x + 0.2 * pitch,
                    y + 0.2 * pitch,
                    x + 0.4 * pitch,
                    y + 0.45 * pitch,
                    (0.8, 0.8, 0.8),
                )
                x += size
        return image

    return paint


def clock() -> Paint:
    """A clock face in polar coordinates for the lid of a cylinder: rows run from the centre outwards."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        image = flat(height, width, (0.93, 0.92, 0.88))
        for hour in range(12):
            middle = (hour + 0.5) / 12 * width
            half = width * (0.008 if hour % 3 else 0.016)
            fill(image, middle - half, 0.74 * height, middle + half, 0.90 * height, (0.1, 0.1, 0.1))
        for angle, reach in ((0.13, 0.7), (0.58, 0.5)):
            fill(image, (angle - 0.010) * width, 0, (angle + 0.010) * width, reach * height, (0.1, 0.1, 0.1))
        fill(image, 0, 0.93 * height, width, height, (0.15, 0.15, 0.17))
        return image

    return paint


def door_leaf(colour: Colour) -> Paint:
    """A panelled door: six raised fields with shaded rims, over grain."""

    def paint(rng: np.random.Generator, height: int, width: int, texel_m: float) -> Floats32:
        grain = fractal(rng, height, width, texel_m, largest_m=0.2, stretch=(5.0, 0.4), gain=0.85)
        shade = 0.05 * grain
        rim = max(1, round(0.012 / texel_m))
        for y0, y1 in ((0.06, 0.22), (0.27, 0.60), (0.66, 0.94)):
            for x0, x1 in ((0.12, 0.46), (0.54, 0.88)):
                a, b, c, d = (round(v) for v in (y0 * height, y1 * height, x0 * width, x1 * width))
                shade[a : a + rim, c:d] -= 0.30
                shade[b - rim : b, c:d] += 0.12
                shade[a:b, c : c + rim] -= 0.18
                shade[a:b, d - rim : d] += 0.08
        return shaded(flat(height, width, colour), shade)

    return paint
