# SPDX-License-Identifier: Apache-2.0
"""Furniture of the synthetic room; its walls are in :mod:`slamdepth.synth.scene`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.synth import paint, prints
from slamdepth.synth.shapes import Surface, box, cylinder, ellipsoid, lathe, leaf, quad


def tinted(rng: np.random.Generator, colour: paint.Colour, spread: float = 0.06) -> paint.Colour:
    """A random colour near ``colour``."""
    r, g, b = np.clip(np.array(colour) + rng.uniform(-spread, spread, 3), 0.02, 0.95)
    return (float(r), float(g), float(b))


def desk(rng: np.random.Generator) -> list[Surface]:
    """A desk by the north wall with a screen, papers, books and a lamp, and a stool in front of it."""
    top, leg = paint.wood(tinted(rng, (0.66, 0.50, 0.34))), paint.plain((0.22, 0.22, 0.24), contrast=0.08)
    out = box((0.95, 3.28, 0.70), (1.70, 0.70, 0.035), top, bottom=True)
    for x in (1.0, 2.54):
        for y in (3.33, 3.87):
            out += box((x, y, 0.0), (0.06, 0.06, 0.70), leg)
    out += box((2.08, 3.36, 0.08), (0.44, 0.56, 0.60), paint.wood((0.60, 0.45, 0.30)))
    for z in (0.12, 0.31, 0.50):
        out += box(
            (2.10, 3.345, z),
            (0.40, 0.02, 0.16),
            {"-y": paint.wood((0.68, 0.52, 0.36)), "*": leg},
            bottom=True,
        )
        out += box((2.25, 3.325, z + 0.09), (0.10, 0.02, 0.015), paint.plain((0.75, 0.75, 0.74)), bottom=True)
    dark = paint.plain((0.08, 0.08, 0.09), contrast=0.05)
    out += box((1.45, 3.78, 0.86), (0.62, 0.035, 0.38), dark, bottom=True)
    out.append(
        replace(quad((1.462, 3.779, 1.228), (0.596, 0, 0), (0, 0, -0.356), prints.screen()), emission=0.8)
    )
    out += box((1.72, 3.79, 0.735), (0.08, 0.03, 0.20), dark) + box(
        (1.64, 3.70, 0.735), (0.24, 0.18, 0.012), dark
    )
    out += box(
        (1.52, 3.42, 0.735),
        (0.44, 0.14, 0.018),
        {"+z": prints.keyboard(), "*": dark},
        yaw=rng.uniform(-0.1, 0.1),
    )
    out += box(
        (2.10, 3.38, 0.735),
        (0.21, 0.30, 0.004),
        {"+z": prints.page(), "*": paint.plain((0.9, 0.9, 0.88))},
        yaw=rng.uniform(-0.5, 0.5),
    )
    out += box(
        (1.08, 3.40, 0.735),
        (0.21, 0.30, 0.006),
        {"+z": prints.page(), "*": paint.plain((0.9, 0.9, 0.88))},
        yaw=rng.uniform(0.1, 0.6),
    )
    out += cylinder(
        (2.42, 3.62, 0.735),
        0.042,
        0.10,
        paint.fabric((0.72, 0.25, 0.20), stripe=(0.92, 0.90, 0.85)),
        paint.plain((0.2, 0.13, 0.09)),
    )
    z = 0.735
    for _ in range(4):
        colour, thick = tinted(rng, (0.45, 0.38, 0.36), 0.3), float(rng.uniform(0.02, 0.045))
        cover = {
            "+z": prints.poster(),
            "-y": paint.wood(colour),
            "*": paint.plain((0.86, 0.83, 0.74), contrast=0.1),
        }
        out += box((1.05, 3.70, z), (0.26, 0.19, thick), cover, yaw=float(rng.uniform(-0.25, 0.25)))
        z += thick
    metal = paint.plain((0.30, 0.42, 0.40), contrast=0.06)
    out += cylinder((2.50, 3.84, 0.735), 0.075, 0.02, metal) + cylinder(
        (2.50, 3.84, 0.755), 0.010, 0.36, metal
    )
    out.append(lathe((2.47, 3.82, 1.07), [(0.025, 0.13), (0.10, 0.0)], metal))
    seat, wheel = paint.fabric(tinted(rng, (0.22, 0.30, 0.42))), paint.plain((0.12, 0.12, 0.13))
    out += box((1.42, 2.86, 0.42), (0.44, 0.42, 0.07), seat, yaw=0.35, bottom=True)
    out += cylinder((1.64, 3.07, 0.06), 0.03, 0.36, wheel)
    out += box((1.38, 3.05, 0.02), (0.52, 0.05, 0.04), wheel, yaw=0.5) + box(
        (1.38, 3.05, 0.02), (0.52, 0.05, 0.04), wheel, yaw=2.0
    )
    return out


def bookshelf(rng: np.random.Generator) -> list[Surface]:
    """A full bookshelf by the north wall."""
    board, out = paint.wood(tinted(rng, (0.48, 0.33, 0.22)), along=False), []
    shelf = paint.wood((0.50, 0.35, 0.24))
    x0, x1, y0, height = 3.15, 4.20, 3.70, 1.95
    out += box((x0 - 0.025, y0, 0.0), (0.025, 0.30, height), board) + box(
        (x1, y0, 0.0), (0.025, 0.30, height), board
    )
    out.append(quad((x0, 3.985, height), (x1 - x0, 0, 0), (0, 0, -height), shelf))
    for z in (0.06, 0.44, 0.82, 1.20, 1.56, height - 0.02):
        out += box((x0, y0, z), (x1 - x0, 0.29, 0.022), shelf, bottom=True)
    for z in (0.082, 0.462, 0.842, 1.222, 1.582):
        x = x0 + 0.01
        gap_at = rng.uniform(x0 + 0.3, x1 - 0.2)
        while x < x1 - 0.06:
            thick = float(rng.uniform(0.020, 0.060))
            if x < gap_at < x + 0.14 and rng.random() < 0.8:
                colour = tinted(rng, (0.5, 0.5, 0.5), 0.3)
                if rng.random() < 0.5:
                    out.append(
                        ellipsoid(
                            (x + 0.08, y0 + 0.14, z + 0.075),
                            (0.075, 0.075, 0.075),
                            paint.checker(colour, (0.9, 0.85, 0.7), 0.05),
                        )
                    )
                else:
                    out.append(
                        lathe(
                            (x + 0.08, y0 + 0.14, z),
                            [(0.03, 0.24), (0.025, 0.2), (0.07, 0.1), (0.04, 0.0)],
                            paint.fabric(colour, stripe=(0.9, 0.88, 0.8)),
                        )
                    )
                x += 0.18
                continue
            tall = float(rng.uniform(0.20, 0.31))
            colour = tinted(rng, prints.pick_ink(rng), 0.08)
            cover = {
                "-y": prints.book(colour),
                "+z": paint.plain((0.85, 0.82, 0.74), contrast=0.1),
                "*": paint.plain(colour),
            }
            out += box((x, y0 + float(rng.uniform(0.01, 0.06)), z), (thick - 0.002, 0.2, tall), cover)
            x += thick
    return out


def sofa(rng: np.random.Generator) -> list[Surface]:
    """A sofa with cushions by the west wall."""
    cloth = paint.fabric(tinted(rng, (0.36, 0.44, 0.50)))
    out = box((0.06, 0.85, 0.06), (0.86, 2.0, 0.34), cloth) + box(
        (0.04, 0.85, 0.06), (0.24, 2.0, 0.74), cloth
    )
    out += box((0.06, 0.65, 0.06), (0.88, 0.20, 0.54), cloth) + box(
        (0.06, 2.85, 0.06), (0.88, 0.20, 0.54), cloth
    )
    for y in (0.88, 1.87):
        out += box((0.30, y, 0.40), (0.64, 0.96, 0.10), cloth)
    for y, colour in ((1.05, (0.78, 0.58, 0.25)), (1.95, (0.65, 0.25, 0.22)), (2.62, (0.85, 0.82, 0.74))):
        cover = paint.fabric(tinted(rng, colour), stripe=tinted(rng, (0.9, 0.86, 0.78)))
        out.append(ellipsoid((0.40, y, 0.66), (0.11, 0.21, 0.19), cover, power=0.65))
    return out


def cabinet(rng: np.random.Generator) -> list[Surface]:
    """A low cabinet with a television by the south wall."""
    body, front = paint.wood(tinted(rng, (0.42, 0.30, 0.21))), paint.wood((0.58, 0.43, 0.30), along=False)
    out = box((1.30, 0.0, 0.0), (1.60, 0.42, 0.62), body)
    for x in (1.33, 1.86, 2.39):
        out += box((x, 0.42, 0.06), (0.48, 0.02, 0.52), {"+y": front, "*": body}, bottom=True)
        out += box((x + 0.06, 0.44, 0.30), (0.02, 0.02, 0.10), paint.plain((0.8, 0.78, 0.7)), bottom=True)
    dark = paint.plain((0.06, 0.06, 0.07))
    out += box((1.62, 0.14, 0.70), (0.98, 0.04, 0.58), dark, bottom=True) + box(
        (1.95, 0.10, 0.62), (0.3, 0.12, 0.08), dark
    )
    out.append(
        replace(quad((2.585, 0.181, 1.265), (-0.95, 0, 0), (0, 0, -0.55), prints.landscape()), emission=0.7)
    )
    out.append(
        lathe(
            (1.45, 0.22, 0.62),
            [(0.04, 0.30), (0.03, 0.25), (0.09, 0.12), (0.05, 0.0)],
            paint.checker((0.25, 0.40, 0.55), (0.85, 0.84, 0.8), 0.03),
        )
    )
    out += box((2.66, 0.10, 0.62), (0.18, 0.2, 0.26), {"+y": prints.poster(), "*": dark}, yaw=0.2)
    return out


def rug_and_table(rng: np.random.Generator) -> list[Surface]:
    """A rug, and a low table with things on it."""
    colours = [
        tinted(rng, c)
        for c in ((0.60, 0.18, 0.16), (0.22, 0.26, 0.38), (0.80, 0.70, 0.52), (0.30, 0.35, 0.28))
    ]
    out = box(
        (1.35, 1.05, 0.0), (2.4, 1.7, 0.008), {"+z": paint.rug(colours), "*": paint.plain((0.4, 0.3, 0.25))}
    )
    top, leg = (
        paint.wood((0.70, 0.55, 0.38), plank_m=0.14, plank_length_m=2.0),
        paint.wood((0.4, 0.28, 0.18), along=False),
    )
    out += box((1.95, 1.55, 0.38), (1.0, 0.6, 0.035), top, bottom=True)
    for x in (2.0, 2.9):
        for y in (1.6, 2.1):
            out += cylinder((x, y, 0.008), 0.025, 0.372, leg)
    for x, y, yaw in ((2.1, 1.7, 0.4), (2.16, 1.74, -0.2), (2.62, 1.62, 0.9)):
        out += box(
            (x, y, 0.415 + 0.012 * (yaw < 0)),
            (0.20, 0.28, 0.012),
            {"+z": prints.poster(), "*": paint.plain((0.85, 0.85, 0.82))},
            yaw=yaw,
        )
    bowl = paint.checker((0.85, 0.83, 0.78), (0.30, 0.42, 0.50), 0.025)
    out.append(lathe((2.55, 1.95, 0.415), [(0.02, 0.03), (0.12, 0.085), (0.125, 0.08), (0.05, 0.0)], bowl))
    for dx, dy, colour in (
        (0.03, 0.0, (0.75, 0.25, 0.15)),
        (-0.04, 0.03, (0.85, 0.6, 0.15)),
        (-0.01, -0.045, (0.45, 0.55, 0.2)),
    ):
        out.append(
            ellipsoid(
                (2.55 + dx, 1.95 + dy, 0.50),
                (0.036, 0.036, 0.036),
                paint.plain(colour, contrast=0.15, largest_m=0.03),
            )
        )
    out.append(
        ellipsoid(
            (3.35, 2.45, 0.128),
            (0.12, 0.12, 0.12),
            paint.checker((0.92, 0.92, 0.90), (0.12, 0.12, 0.14), 0.06),
        )
    )
    return out


def plant(rng: np.random.Generator) -> list[Surface]:
    """A potted plant in the north-east corner."""
    pot = paint.fabric((0.68, 0.42, 0.30), stripe=(0.60, 0.35, 0.25))
    out: list[Surface] = [
        lathe((4.60, 3.60, 0.0), [(0.03, 0.30), (0.17, 0.30), (0.19, 0.36), (0.17, 0.30), (0.13, 0.0)], pot)
    ]
    for k in range(22):
        green = tinted(rng, (0.22, 0.42, 0.16), 0.07)
        blade = paint.fabric(green, stripe=(green[0] * 1.5, green[1] * 1.35, green[2] * 1.4))
        root = (4.60 + float(rng.uniform(-0.05, 0.05)), 3.60 + float(rng.uniform(-0.05, 0.05)), 0.30)
        length = float(rng.uniform(0.16, 0.36))
        out += leaf(
            root, 2.4 * k, length, float(rng.uniform(0.06, 0.10)), float(rng.uniform(0.5, 1.1)), blade
        )
    return out


def corners(rng: np.random.Generator) -> list[Surface]:
    """Cartons in one corner, a floor lamp in another, a stool under the window."""
    card = prints.cardboard()
    out = box((0.12, 0.12, 0.0), (0.55, 0.42, 0.38), card, yaw=0.08) + box(
        (0.16, 0.14, 0.38), (0.42, 0.34, 0.28), card, yaw=-0.2
    )
    out += box((0.72, 0.16, 0.0), (0.36, 0.36, 0.30), card, yaw=0.5)
    metal = paint.plain((0.25, 0.24, 0.22), contrast=0.1)
    out += cylinder((0.45, 3.55, 0.0), 0.14, 0.025, metal) + cylinder((0.45, 3.55, 0.025), 0.014, 1.42, metal)
    shade = paint.plain((0.96, 0.88, 0.70), contrast=0.03, largest_m=0.1)
    for inner in (False, True):
        profile = [(0.13, 1.72), (0.21, 1.40)]
        surface = lathe((0.45, 3.55, 0.0), profile, shade)
        out.append(
            replace(surface, emission=0.95, points=surface.points[:, ::-1] if inner else surface.points)
        )
    seat = paint.fabric(tinted(rng, (0.70, 0.55, 0.30)), stripe=(0.45, 0.28, 0.22))
    out += cylinder((4.25, 2.55, 0.0), 0.20, 0.42, seat)
    out += box((4.32, 0.70, 0.0), (0.50, 0.50, 0.52), paint.wood((0.55, 0.40, 0.28)), yaw=0.15)
    out.append(
        ellipsoid(
            (4.57, 0.95, 0.64),
            (0.12, 0.12, 0.12),
            paint.plain((0.30, 0.45, 0.62), contrast=0.25, largest_m=0.1),
        )
    )
    return out
