# SPDX-License-Identifier: Apache-2.0
"""A hall of identical workstations, doors and tiles, in which one place looks like the next.

The hall runs along x, with z up and a corner of the floor at ``(0, Hall.south_m, 0)``. Its bays are the same
up to a translation, texture and light included. The end walls and what stands before them differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamdepth.synth import furniture, paint, prints
from slamdepth.synth.furniture import tinted
from slamdepth.synth.scene import Lamp, Scene, door, with_texture
from slamdepth.synth.shapes import Surface, box, cylinder, moved, quad

NORTH_M = 4.0
HEIGHT_M = 2.6
_DESK_X_M, _DOOR_X_M = 1.80, 4.38  # of the middle of the shared furniture where it is built
_CEILING_LAMP = (1.9, 1.8, 1.62)


@dataclass(frozen=True)
class Hall:
    """The measures of a hall.

    Attributes:
        bays: number of workstations.
        spacing_m: from one workstation to the next.
        south_m: y of the south wall; the workstations stand at the north wall, y = ``NORTH_M``.
        has_north_doors: there is a door next to each workstation, and not only on the other side.
    """

    bays: int
    spacing_m: float
    south_m: float
    has_north_doors: bool

    @staticmethod
    def of(seed: int) -> Hall:
        """The hall of a seed: 5 to 8 bays of 1.95 to 2.60 m, or 4 to 6 of 3.20 to 3.60 m with a door each."""
        rng = np.random.default_rng([seed, 8])
        has_north_doors = bool(rng.random() < 0.4)
        fewest, narrowest, widest = (4, 3.20, 3.60) if has_north_doors else (5, 1.95, 2.60)
        return Hall(
            int(rng.integers(fewest, fewest + (3 if has_north_doors else 4))),
            round(float(rng.uniform(narrowest, widest)), 2),
            round(float(rng.uniform(-0.6, 0.4)), 2),
            has_north_doors,
        )

    @property
    def length_m(self) -> float:
        """From the west wall, x = 0, to the east wall."""
        return self.bays * self.spacing_m

    @property
    def centres_m(self) -> list[float]:
        """The x of the middle of each bay."""
        return [(k + 0.5) * self.spacing_m for k in range(self.bays)]


def build_aliased_scene(seed: int, texture: str) -> Scene:
    """Build the hall of :meth:`Hall.of`.

    Args:
        seed: varies the measures, colours, prints and furniture.
        texture: as for :func:`slamdepth.synth.scene.build_scene`.
    """
    hall = Hall.of(seed)
    rng = np.random.default_rng([seed, 9])
    bay = [replace(surface, texture_id=f"bay {k}") for k, surface in enumerate(_bay(rng, hall))]
    middle, *others = sorted(hall.centres_m, key=lambda x: abs(x - hall.length_m / 2))
    surfaces = moved(bay, (middle, 0.0, 0.0))  # the first one is lit for all: one with neighbours
    for x in others:
        surfaces += moved(bay, (x, 0.0, 0.0))
    surfaces += _ends(rng, hall)
    lamp_y = (hall.south_m + NORTH_M) / 2
    lamps = [
        Lamp((x, lamp_y, HEIGHT_M - 0.05), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), _CEILING_LAMP)
        for x in hall.centres_m
    ]
    return Scene(with_texture(surfaces, texture), lamps)


def _bay(rng: np.random.Generator, hall: Hall) -> list[Surface]:
    """One bay about x = 0, from wall to wall and from floor to ceiling."""
    south, spacing = hall.south_m, hall.spacing_m
    width, left = NORTH_M - south, -spacing / 2
    floor = paint.tiles(tinted(rng, (0.52, 0.48, 0.42)), (0.25, 0.24, 0.23), 4, max(4, round(width / 0.5)))
    wall = paint.tiles(tinted(rng, (0.70, 0.74, 0.72)), (0.50, 0.50, 0.48), 8, 4)
    cream = paint.plaster(tinted(rng, (0.80, 0.77, 0.70), 0.04))
    out = [
        quad((left, NORTH_M, 0), (spacing, 0, 0), (0, -width, 0), floor),
        quad((left, south, HEIGHT_M), (spacing, 0, 0), (0, width, 0), paint.plaster((0.90, 0.89, 0.87))),
        quad((left, NORTH_M, HEIGHT_M), (spacing, 0, 0), (0, 0, -HEIGHT_M), cream),
        quad((-left, south, HEIGHT_M), (-spacing, 0, 0), (0, 0, 1.1 - HEIGHT_M), cream),
        quad((-left, south, 1.1), (-spacing, 0, 0), (0, 0, -1.1), wall),
    ]
    panel = quad(
        (-0.3, (south + NORTH_M) / 2 - 0.3, HEIGHT_M - 0.02), (0.6, 0, 0), (0, 0.6, 0),
        paint.plain((0.98, 0.96, 0.90), contrast=0.01),
    )  # fmt: skip
    out.append(replace(panel, emission=1.0))
    desk_x = -0.62 if hall.has_north_doors else 0.0
    workstation = [*furniture.desk(rng), *_chair_back(rng), *_wall_shelf(rng)]
    out += moved(workstation, (desk_x - _DESK_X_M, 0.0, 0.0))
    out += moved(door(), (-_DOOR_X_M, south, 0.0))
    if hall.has_north_doors:
        out += moved(door(), (4.97, NORTH_M, 0.0), half_turn=True)
    width_m, height_m = float(rng.uniform(0.34, 0.44)), float(rng.uniform(0.5, 0.7))
    edge = paint.wood(tinted(rng, (0.36, 0.27, 0.20)))
    out += box(
        (0.36, south, float(rng.uniform(1.15, 1.4))), (width_m, 0.022, height_m),
        {"+y": prints.poster(), "*": edge}, bottom=True,
    )  # fmt: skip
    if rng.random() < 0.5:
        cloth = paint.fabric(tinted(rng, (0.40, 0.46, 0.50)), stripe=tinted(rng, (0.52, 0.56, 0.58)))
        out += box((left + 0.005, 3.25, 0.0), (0.04, 0.75, float(rng.uniform(1.1, 1.35))), cloth)
    return out


def _chair_back(rng: np.random.Generator) -> list[Surface]:
    """The back of the seat that :func:`slamdepth.synth.furniture.desk` puts before the desk."""
    cloth = paint.fabric(tinted(rng, (0.30, 0.32, 0.42), 0.15), stripe=(0.62, 0.58, 0.50))
    post = cylinder((1.66, 2.86, 0.46), 0.022, 0.30, paint.plain((0.12, 0.12, 0.13)))
    return box((1.45, 2.82, 0.66), (0.40, 0.05, 0.36), cloth, yaw=0.35, bottom=True) + post


def _wall_shelf(rng: np.random.Generator) -> list[Surface]:
    """A shelf with books and a poster on the wall above the desk."""
    z = float(rng.uniform(1.50, 1.66))
    out = box((0.98, 3.76, z), (0.92, 0.24, 0.025), paint.wood(tinted(rng, (0.48, 0.35, 0.24))), bottom=True)
    x = 1.0
    while x < 1.82:
        thick, tall = float(rng.uniform(0.022, 0.060)), float(rng.uniform(0.20, 0.31))
        colour = tinted(rng, prints.pick_ink(rng), 0.08)
        cover = {"-y": prints.book(colour), "*": paint.plain(colour)}
        y = 3.78 + float(rng.uniform(0.0, 0.04))
        out += box((x, y, z + 0.025), (thick - 0.002, 0.18, tall), cover)
        x += thick if rng.random() < 0.85 else thick + 0.08
    width_m, height_m = float(rng.uniform(0.42, 0.56)), float(rng.uniform(0.55, 0.75))
    print_ = prints.poster() if rng.random() < 0.7 else prints.landscape()
    out += box(
        (2.04, NORTH_M - 0.022, 1.40), (width_m, 0.022, height_m),
        {"-y": print_, "*": paint.wood((0.30, 0.22, 0.16))}, bottom=True,
    )  # fmt: skip
    return out


def _ends(rng: np.random.Generator, hall: Hall) -> list[Surface]:
    """The two end walls, each with prints of its own, cartons in the west and a plant in the east."""
    south, length, width = hall.south_m, hall.length_m, NORTH_M - hall.south_m
    brick = paint.brick(tinted(rng, (0.62, 0.37, 0.29), 0.05))
    paper = paint.wallpaper(tinted(rng, (0.70, 0.76, 0.74)), tinted(rng, (0.38, 0.52, 0.50)))
    out = [
        quad((0, south, HEIGHT_M), (0, width, 0), (0, 0, -HEIGHT_M), brick),
        quad((length, NORTH_M, HEIGHT_M), (0, -width, 0), (0, 0, -HEIGHT_M), paper),
    ]
    for k in range(3):
        y = south + 0.35 + k * (width - 0.9) / 2
        for x, face in ((0.0, "+x"), (length - 0.022, "-x")):
            z, wide, tall = (float(rng.uniform(*span)) for span in ((1.0, 1.4), (0.4, 0.6), (0.5, 0.8)))
            print_ = prints.poster() if rng.random() < 0.6 else prints.landscape()
            faces = {face: print_, "*": paint.wood((0.30, 0.22, 0.16))}
            out += box((x, y, z), (0.022, wide, tall), faces, bottom=True)
    card = prints.cardboard()
    out += box((0.06, south + 0.06, 0.0), (0.42, 0.36, 0.34), card, yaw=0.1)
    out += box((0.08, south + 0.10, 0.34), (0.34, 0.30, 0.24), card, yaw=-0.2)
    return out + moved(furniture.plant(rng), (length - 0.24 - 4.60, south + 0.4 - 3.60, 0.0))
