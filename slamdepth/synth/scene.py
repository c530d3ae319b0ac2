# SPDX-License-Identifier: Apache-2.0
"""The furnished room: 5 x 4 x 2.6 m, z up, with a corner of the floor at the origin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamdepth.fiducial import MarkerSpec
from slamdepth.synth import furniture, paint, prints
from slamdepth.synth.furniture import tinted
from slamdepth.synth.marker import hung_marker
from slamdepth.synth.shapes import Paint, Surface, box, lathe, quad

ROOM_M = (5.0, 4.0, 2.6)


@dataclass(frozen=True)
class Lamp:
    """A rectangular lamp: the points ``centre + a * edge_a + b * edge_b`` for a, b in -1 to 1.

    Attributes:
        centre, edge_a, edge_b: metres.
        power: red, green and blue, in arbitrary linear units.
    """

    centre: tuple[float, float, float]
    edge_a: tuple[float, float, float]
    edge_b: tuple[float, float, float]
    power: tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """Surfaces in metres (z up) and the lamps that light them."""

    surfaces: list[Surface]
    lamps: list[Lamp]


def build_scene(seed: int, texture: str, marker: MarkerSpec | None = None) -> Scene:
    """Build the room.

    Args:
        seed: varies colours, books, prints and small placements.
        texture: ``"rich"``; ``"low"``, with faint contrast; ``"bare"``, a white model of the large
            furniture, which shows light and shape only.
        marker: hangs on a wall, whatever the texture; None for none.
    """
    rng = np.random.default_rng([seed, 2])
    surfaces = [
        *shell(rng), *window(), *door(), *furniture.desk(rng), *furniture.bookshelf(rng),
        *furniture.sofa(rng), *furniture.cabinet(rng), *furniture.rug_and_table(rng),
        *furniture.plant(rng), *furniture.corners(rng), *framed_prints(rng),
    ]  # fmt: skip
    if texture == "bare":
        surfaces = [
            *shell(rng), *window(), *door(), *furniture.desk(rng), *furniture.sofa(rng),
            *furniture.cabinet(rng), *furniture.rug_and_table(rng), *furniture.corners(rng),
        ]  # fmt: skip
    surfaces = with_texture(surfaces, texture)
    if marker is not None:
        surfaces.append(hung_marker(marker))  # last, so that the rest looks as without it
    lamps = [
        Lamp((2.5, 2.0, 2.50), (0.22, 0.0, 0.0), (0.0, 0.22, 0.0), (3.0, 2.75, 2.35)),
        Lamp((4.93, 2.0, 1.55), (0.0, 0.65, 0.0), (0.0, 0.0, 0.6), (3.4, 3.7, 4.2)),
        Lamp((0.45, 3.55, 1.60), (0.10, 0.0, 0.0), (0.0, 0.10, 0.0), (0.9, 0.7, 0.45)),
    ]
    return Scene(surfaces, lamps)


def with_texture(surfaces: list[Surface], texture: str) -> list[Surface]:
    """The surfaces with ``"rich"``, ``"low"`` or ``"bare"`` texture; what shines keeps its own."""
    if texture == "rich":
        return surfaces
    white = paint.plain((0.8, 0.8, 0.8), contrast=0.0)
    return [
        s if s.emission else replace(s, paint=paint.muted(s.paint, 0.15) if texture == "low" else white)
        for s in surfaces
    ]


def _toned(rng: np.random.Generator, colour: paint.Colour) -> paint.Colour:
    r, g, b = np.clip(np.array(colour) * rng.uniform(0.5, 1.7), 0.02, 0.95)
    return (float(r), float(g), float(b))


def shell(rng: np.random.Generator) -> list[Surface]:
    """Floor, ceiling, walls (north, south, east, west), skirting boards and the ceiling lamp."""
    x, y, z = ROOM_M
    plank = paint.wood(tinted(rng, (0.56, 0.40, 0.26)), plank_m=0.12)
    cream = tinted(rng, (0.80, 0.76, 0.68), 0.03)
    surfaces = [
        quad((0, y, 0), (x, 0, 0), (0, -y, 0), plank),
        quad((0, 0, z), (x, 0, 0), (0, y, 0), paint.plaster((0.90, 0.89, 0.87)), texel_scale=1.5),
        quad((0, y, z), (x, 0, 0), (0, 0, -z), paint.plaster(cream)),
        quad((x, 0, z), (-x, 0, 0), (0, 0, -z), paint.wallpaper((0.70, 0.76, 0.74), (0.38, 0.52, 0.50))),
        quad((x, y, z), (0, -y, 0), (0, 0, -z), paint.plaster(tinted(rng, (0.66, 0.72, 0.78), 0.03))),
        quad((0, 0, z), (0, y, 0), (0, 0, -z), paint.brick(tinted(rng, (0.62, 0.37, 0.29), 0.04))),
    ]
    white = paint.plain((0.86, 0.85, 0.82))
    for low, size in (
        ((0.0, y - 0.015, 0.0), (x, 0.015, 0.10)),
        ((0.0, 0.0, 0.0), (x, 0.015, 0.10)),
        ((0.0, 0.0, 0.0), (0.015, y, 0.10)),
        ((x - 0.015, 0.0, 0.0), (0.015, y, 0.10)),
    ):
        surfaces += box(low, size, white)
    shade = paint.plain((0.98, 0.95, 0.88), contrast=0.01)
    surfaces.append(
        replace(
            lathe((2.5, 2.0, 2.48), [(0.20, 0.12), (0.24, 0.05), (0.20, 0.0), (1e-3, -0.02)], shade),
            emission=1.0,
        )
    )
    return surfaces


def window() -> list[Surface]:
    """A bright window in the east wall, with sill, bars, curtains and a radiator."""
    white, y0, y1, z0, z1 = paint.plain((0.90, 0.90, 0.88)), 1.3, 2.7, 0.95, 2.15
    out = [
        replace(quad((4.985, y1, z1), (0, y0 - y1, 0), (0, 0, z0 - z1), prints.landscape()), emission=1.35)
    ]
    for y in (y0 - 0.05, (y0 + y1) / 2 - 0.025, y1):
        out += box((4.95, y, z0 - 0.05), (0.05, 0.05, z1 - z0 + 0.10), white, bottom=True)
    for z in (z0 - 0.05, z0 + 0.75, z1):
        out += box((4.95, y0 - 0.05, z), (0.05, y1 - y0 + 0.10, 0.05), white, bottom=True)
    out += box(
        (4.80, y0 - 0.12, z0 - 0.08),
        (0.20, y1 - y0 + 0.24, 0.03),
        paint.wood((0.72, 0.60, 0.45), along=False),
        bottom=True,
    )
    for i, y in enumerate((y0 - 0.42, y1 + 0.06)):
        fold = np.linspace(0.0, 1.0, 41)
        cloth = np.empty((2, 41, 3))
        cloth[..., 0] = 4.90 + 0.025 * np.sin(fold * (34.0 + i))
        cloth[..., 1] = y + 0.36 * (1.0 - fold)
        cloth[..., 2] = np.array([2.35, 0.12])[:, None]
        out.append(Surface(cloth, (0.5, 2.2), paint.fabric((0.55, 0.30, 0.26), stripe=(0.80, 0.68, 0.50))))
    out += box(
        (4.88, y0 - 0.45, 2.34),
        (0.03, y1 - y0 + 0.90, 0.03),
        paint.wood((0.3, 0.2, 0.14), along=True),
        bottom=True,
    )
    for y in np.arange(y0 + 0.1, y1 - 0.15, 0.09):
        out += box((4.86, float(y), 0.18), (0.12, 0.065, 0.58), white)
    return out


def door() -> list[Surface]:
    """A panelled door in the south wall."""
    frame, leaf_ = paint.plain((0.84, 0.83, 0.79)), prints.door_leaf((0.62, 0.47, 0.33))
    out = box((3.65, 0.0, 0.0), (0.08, 0.05, 2.08), frame) + box((4.53, 0.0, 0.0), (0.08, 0.05, 2.08), frame)
    out += box((3.65, 0.0, 2.05), (0.96, 0.05, 0.08), frame, bottom=True)
    out += box((3.73, 0.0, 0.0), (0.80, 0.025, 2.05), {"+y": leaf_, "*": frame})
    out += box((3.80, 0.025, 0.98), (0.14, 0.05, 0.025), paint.plain((0.75, 0.72, 0.62)), bottom=True)
    out += box(
        (3.40, 0.0, 1.08), (0.08, 0.012, 0.08), paint.checker((0.92, 0.92, 0.9), (0.8, 0.8, 0.78), 0.027)
    )
    return out


def framed_prints(rng: np.random.Generator) -> list[Surface]:
    """Framed prints and a clock on the walls."""
    out = []
    # wall, place along it, height of the lower edge, width, height
    for wall, a, z, w, h, print_ in (
        ("N", 0.25, 1.15, 0.45, 0.62, prints.poster()),
        ("N", 1.05, 1.42, 0.50, 0.70, prints.poster()),
        ("N", 1.72, 1.50, 0.80, 0.55, prints.landscape()),
        ("N", 2.66, 1.30, 0.36, 0.50, prints.poster()),
        ("W", 0.90, 1.15, 0.55, 0.75, prints.poster()),
        ("W", 1.65, 1.25, 0.90, 0.62, prints.landscape()),
        ("W", 2.75, 1.12, 0.42, 0.58, prints.poster()),
        ("S", 0.45, 1.10, 0.55, 0.75, prints.poster()),
        ("S", 1.35, 1.55, 0.60, 0.42, prints.landscape()),
        ("S", 2.25, 1.50, 0.40, 0.55, prints.poster()),
        ("S", 2.85, 1.05, 0.42, 0.60, prints.poster()),
        ("E", 0.15, 1.20, 0.50, 0.68, prints.poster()),
        ("E", 3.30, 1.25, 0.50, 0.70, prints.poster()),
    ):
        edge = paint.wood(_toned(rng, (0.36, 0.27, 0.20)))
        out += _hung(wall, a - 0.03, z - 0.03, w + 0.06, h + 0.06, 0.018, edge, edge)
        out += _hung(wall, a, z, w, h, 0.022, print_, edge)
    dial = lathe((0.0, 0.0, 0.0), [(1e-4, 0.03), (0.15, 0.03)], prints.clock())
    rim = lathe((0.0, 0.0, 0.0), [(0.15, 0.03), (0.15, 0.0)], paint.plain((0.15, 0.15, 0.17)))
    for part in (dial, rim):  # rotated from horizontal to hang on the north wall
        x, y, z = np.moveaxis(part.points, -1, 0)
        out.append(replace(part, points=np.stack([x + 2.85, ROOM_M[1] - z, y + 2.15], axis=-1)))
    return out


def _hung(
    wall: str, a: float, z: float, w: float, h: float, thick: float, face: Paint, edge: Paint
) -> list[Surface]:
    x, y, _ = ROOM_M
    low, size, front = {
        "N": ((a, y - thick, z), (w, thick, h), "-y"),
        "S": ((a, 0.0, z), (w, thick, h), "+y"),
        "E": ((x - thick, a, z), (thick, w, h), "-x"),
        "W": ((0.0, a, z), (thick, w, h), "+x"),
    }[wall]
    return box(low, size, {front: face, "*": edge}, bottom=True)
