# SPDX-License-Identifier: Apache-2.0
"""Synthetic rooms for training, as diverse as possible with true sizes.

They are rooms of ``slamdepth synth`` with walls stretched and repainted, and furniture moved, rotated,
resized or left out. Workplaces with screens, keyboards, paper and crockery at their real sizes are added,
since known sizes are what gives a network metric scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slamdepth.geometry import so3_exp
from slamdepth.synth import furniture, paint, prints
from slamdepth.synth.scene import ROOM_M, Lamp, Scene, build_scene, door, framed_prints, shell, window
from slamdepth.synth.shapes import Paint, Surface, box, cylinder, ellipsoid, lathe

UP = np.array([0.0, 0.0, 1.0])
_GROUPS = ("desk", "bookshelf", "sofa", "cabinet", "rug_and_table", "plant", "corners")
_WALL_M = 2.2  # longer surfaces are wall, floor or ceiling
_REPAINTED = 0.3  # share of a group's surfaces that get another material
_DARK, _PALE = paint.plain((0.07, 0.07, 0.08), contrast=0.06), paint.plain((0.86, 0.85, 0.83))


def varied_scene(seed: int) -> Scene:
    """Room number ``seed``: its surfaces (z up, metres, corner at the origin) and lamps."""
    rng = np.random.default_rng([seed, 13])
    stretch = np.array([rng.uniform(0.6, 1.5), rng.uniform(0.7, 1.6), rng.uniform(0.9, 1.2)])
    room = np.array(ROOM_M) * stretch
    surfaces = [moved(s, np.diag(stretch), np.zeros(3)) for s in _shell(rng)]
    for name in _GROUPS:
        if rng.random() < 0.4:
            continue
        group = list(getattr(furniture, name)(rng))
        if rng.random() < 0.6:
            group = [replace(s, paint=any_paint(rng)) if _may_change(s, rng) else s for s in group]
        points = np.concatenate([s.points.reshape(-1, 3) for s in group])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 * [1, 1, 0]
        A = so3_exp(UP * rng.uniform(-np.pi, np.pi)) * rng.uniform(0.9, 1.1)
        place = np.append(rng.uniform(0.15, 0.85, 2) * room[:2], 0.0)
        if rng.random() < 0.35:  # at its wall, as in the original room
            A, place = np.eye(3), middle * stretch
        surfaces += [moved(s, A, place - A @ middle) for s in group]
    for _ in range(rng.integers(1, 4)):
        place = np.append(rng.uniform(0.2, 0.8, 2) * room[:2], 0.0)
        A = so3_exp(UP * rng.uniform(-np.pi, np.pi))
        surfaces += [moved(s, A, place) for s in workplace(rng)]
    for _ in range(rng.integers(0, 10)):
        place = np.append(rng.uniform(0.08, 0.92, 2) * room[:2], 0.0)
        surfaces += [moved(s, np.eye(3), place) for s in block(rng, 0.3)]
    return Scene(surfaces, _lamps(rng, seed, stretch))


def simple_scene(seed: int) -> Scene:
    """Room ``seed`` with little texture, as offices and new flats: white walls and single colours.

    The share of repainted surfaces is random, from a third to all. Surfaces that emit light stay.
    """
    rng = np.random.default_rng([seed, 17])
    scene = varied_scene(seed)
    share = rng.uniform(0.3, 1.0)
    wall = paint.plain(grey(rng, 0.6, 0.95), contrast=rng.uniform(0.0, 0.03))

    floor = rng.random() < 0.4

    def repainted(surface: Surface) -> Surface:
        size_m = np.ptp(surface.points.reshape(-1, 3), axis=0)
        large = size_m.max() > _WALL_M and (floor or surface.points[..., 2].max() > 0.0)
        if surface.emission > 0 or (rng.random() > share and not large):
            return surface
        kind = rng.random()
        if large or kind < 0.3:
            return replace(surface, paint=wall)
        if kind < 0.6:
            return replace(surface, paint=paint.muted(surface.paint, rng.uniform(0.0, 0.3)))
        return replace(surface, paint=paint.plain(grey(rng), contrast=rng.uniform(0.0, 0.03)))

    return replace(scene, surfaces=[repainted(s) for s in scene.surfaces])


def moved(surface: Surface, A: np.ndarray, t: np.ndarray) -> Surface:
    """``surface`` after the linear map ``A (3, 3)`` and the shift ``t (3,)``; its texture stretches too."""
    return replace(surface, points=surface.points @ A.T + t)


def workplace(rng: np.random.Generator) -> list[Surface]:
    """A table at the origin with things of an office or kitchen on it, and chairs."""
    width, depth, height = rng.uniform(0.9, 2.0), rng.uniform(0.6, 1.0), rng.uniform(0.70, 0.78)
    top = [paint.wood(timber(rng)), paint.plain(grey(rng, 0.6, 0.95)), paint.plain(grey(rng))]
    out = box(
        (-width / 2, -depth / 2, height - 0.03), (width, depth, 0.03), top[rng.integers(3)], bottom=True
    )
    leg = paint.plain(grey(rng))
    for x in (-width / 2 + 0.03, width / 2 - 0.08):
        for y in (-depth / 2 + 0.03, depth / 2 - 0.08):
            out += box((x, y, 0.0), (0.05, 0.05, height - 0.03), leg)
    for _ in range(rng.integers(3, 16)):
        thing = THINGS[rng.integers(len(THINGS))](rng)
        place = np.array([rng.uniform(-0.45, 0.45) * width, rng.uniform(-0.42, 0.42) * depth, height])
        A = so3_exp(UP * rng.normal(0.0, 0.6)) * rng.uniform(0.92, 1.08)
        out += [moved(s, A, place) for s in thing]
    for _ in range(rng.integers(0, 3)):
        place = np.array([rng.uniform(-0.5, 0.5) * width, rng.choice([-1, 1]) * rng.uniform(0.5, 1.0), 0.0])
        A = so3_exp(UP * rng.uniform(-np.pi, np.pi))
        out += [moved(s, A, place) for s in _chair(rng)]
    return out


def _shell(rng: np.random.Generator) -> list[Surface]:
    """Walls, floor, ceiling, window, door and framed prints, most of them painted as in offices."""
    out = [*shell(rng)]
    floors = [paint.wood(timber(rng), plank_m=rng.uniform(0.06, 0.2)),
              paint.fabric(colour(rng, 0.1, 0.6)), paint.plain(grey(rng), contrast=0.06),
              paint.checker(grey(rng), grey(rng), float(rng.uniform(0.2, 0.5)))]  # fmt: skip
    if rng.random() < 0.75:
        out[0] = replace(out[0], paint=floors[rng.integers(len(floors))])
    for k in range(2, 6):
        if rng.random() < 0.75:
            plain = paint.plain(grey(rng, 0.55, 0.95), contrast=0.02)
            wall = [plain, plain, paint.plaster(colour(rng, 0.5, 0.95)), paint.wood(timber(rng))]
            out[k] = replace(out[k], paint=wall[rng.integers(len(wall))])
    for group in (window(), door(), framed_prints(rng)):
        if rng.random() < 0.75:
            out += group
    return out


def _lamps(rng: np.random.Generator, seed: int, stretch: np.ndarray) -> list[Lamp]:
    base = build_scene(seed, "rich").lamps
    common = np.exp(rng.normal(0.1, 0.4))
    return [
        replace(
            lamp,
            centre=tuple(np.array(lamp.centre) * stretch * [1, 1, 0.98]),
            power=tuple(
                common * np.array(lamp.power) * np.exp(rng.normal(0, 0.4)) * np.exp(rng.normal(0, 0.1, 3))
            ),
        )
        for lamp in base
    ]


def _may_change(surface: Surface, rng: np.random.Generator) -> bool:
    return surface.emission == 0 and rng.random() < _REPAINTED


def colour(rng: np.random.Generator, low: float = 0.05, high: float = 0.95) -> paint.Colour:
    """A colour of random hue and mostly low saturation."""
    level = rng.uniform(low, high)
    r, g, b = np.clip(level * np.exp(rng.normal(0, 0.18, 3)), 0.02, 0.97)
    return (float(r), float(g), float(b))


def timber(rng: np.random.Generator) -> paint.Colour:
    """A colour of wood, from ebony to birch."""
    level = rng.uniform(0.18, 0.85)
    r, g, b = level * np.array([1.0, rng.uniform(0.68, 0.85), rng.uniform(0.42, 0.68)])
    return (float(r), float(g), float(b))


def grey(rng: np.random.Generator, low: float = 0.05, high: float = 0.95) -> paint.Colour:
    """A nearly grey colour."""
    r, g, b = np.clip(rng.uniform(low, high) * np.exp(rng.normal(0, 0.05, 3)), 0.02, 0.97)
    return (float(r), float(g), float(b))


def any_paint(rng: np.random.Generator) -> Paint:
    """A random material."""
    of = colour(rng)
    paints = [paint.plain(of), paint.plain(grey(rng)), prints.book(of), prints.cardboard(),
              prints.poster(), paint.fabric(of), paint.wood(timber(rng)),
              prints.page()]  # fmt: skip
    return paints[rng.integers(len(paints))]


def block(rng: np.random.Generator, size_m: float) -> list[Surface]:
    """A box, cylinder or ball of any material, at a random size."""
    kind, chosen = rng.random(), any_paint(rng)
    sx, sy, sz = size_m * np.exp(rng.uniform(-0.9, 0.9, 3))
    if kind < 0.5:
        return box((-sx / 2, -sy / 2, 0.0), (sx, sy, sz), chosen, yaw=rng.uniform(0, np.pi))
    if kind < 0.8:
        return cylinder((0.0, 0.0, 0.0), 0.4 * sx, sz, chosen)
    return [ellipsoid((0.0, 0.0, sz / 2), (sx / 2, sy / 2, sz / 2), chosen)]


def _monitor(rng: np.random.Generator) -> list[Surface]:
    w, h, foot = rng.uniform(0.40, 0.68), rng.uniform(0.28, 0.40), rng.uniform(0.06, 0.16)
    case = _DARK if rng.random() < 0.75 else _PALE
    out = box((-w / 2, -0.02, foot), (w, 0.04, h), case, bottom=True)
    face = box((-w / 2 + 0.015, -0.022, foot + 0.015), (w - 0.03, 0.004, h - 0.03), prints.screen())
    glow = rng.uniform(0.5, 1.3) if rng.random() < 0.5 else 0.0
    out += [replace(s, emission=glow, paint=s.paint if glow else _DARK) for s in face]
    return (
        out
        + box((-0.03, -0.02, 0.0), (0.06, 0.04, foot), case)
        + box((-0.13, -0.1, 0.0), (0.26, 0.2, 0.012), case)
    )


def _keyboard(rng: np.random.Generator) -> list[Surface]:
    return box((-0.22, -0.07, 0.0), (0.44, 0.14, 0.02), {"+z": prints.keyboard(), "*": _DARK})


def _laptop(rng: np.random.Generator) -> list[Surface]:
    case = paint.plain(grey(rng, 0.05, 0.75))
    out = box((-0.17, -0.12, 0.0), (0.34, 0.24, 0.02), {"+z": prints.keyboard(), "*": case})
    lid = box((-0.17, 0.0, 0.0), (0.34, 0.01, 0.23), {"-y": prints.screen(), "*": case})
    A = so3_exp(np.array([-rng.uniform(0.1, 0.5), 0.0, 0.0]))
    return out + [moved(s, A, np.array([0.0, 0.12, 0.015])) for s in lid]


def _paper(rng: np.random.Generator) -> list[Surface]:
    out: list[Surface] = []
    for k in range(rng.integers(1, 5)):
        low = (-0.105 + rng.normal(0, 0.08), -0.15 + rng.normal(0, 0.08), 0.003 * k)
        out += box(low, (0.21, 0.297, 0.003), {"+z": prints.page(), "*": _PALE}, yaw=rng.uniform(-1.5, 1.5))
    return out


def _books(rng: np.random.Generator) -> list[Surface]:
    out, z = [], 0.0
    for _ in range(rng.integers(1, 6)):
        w, d, thick = rng.uniform(0.12, 0.22), rng.uniform(0.18, 0.30), rng.uniform(0.01, 0.05)
        cover = {"+z": prints.poster(), "-y": prints.book(colour(rng)), "*": _PALE}
        out += box((-w / 2, -d / 2, z), (w, d, thick), cover, yaw=rng.uniform(-0.4, 0.4))
        z += thick
    return out


def _binders(rng: np.random.Generator) -> list[Surface]:
    out: list[Surface] = []
    for k in range(rng.integers(1, 6)):
        sides = {"-y": prints.book(colour(rng)), "*": paint.plain(colour(rng))}
        out += box((0.08 * k, -0.14, 0.0), (0.075, 0.28, 0.32), sides)
    return out


def _mug(rng: np.random.Generator) -> list[Surface]:
    return cylinder((0.0, 0.0, 0.0), rng.uniform(0.035, 0.045), rng.uniform(0.08, 0.11),
                    paint.fabric(colour(rng)), paint.plain((0.15, 0.1, 0.07)))  # fmt: skip


def _bottle(rng: np.random.Generator) -> list[Surface]:
    r, h = rng.uniform(0.03, 0.045), rng.uniform(0.18, 0.32)
    profile = [(0.012, h), (0.013, 0.88 * h), (r, 0.68 * h), (r, 0.0)]
    return [lathe((0.0, 0.0, 0.0), profile, paint.plain(colour(rng)))]


def _lamp(rng: np.random.Generator) -> list[Surface]:
    metal, h = paint.plain(colour(rng), contrast=0.06), rng.uniform(0.3, 0.5)
    out = [*cylinder((0.0, 0.0, 0.0), 0.08, 0.02, metal), *cylinder((0.0, 0.0, 0.02), 0.01, h, metal)]
    return [*out, lathe((0.0, 0.0, h - 0.06), [(0.03, 0.14), (0.11, 0.0)], metal)]


def _fruit(rng: np.random.Generator) -> list[Surface]:
    return [
        ellipsoid((*rng.normal(0, 0.06, 2), 0.04), (0.04, 0.04, 0.04), paint.plain(colour(rng), contrast=0.1))
        for _ in range(rng.integers(1, 6))
    ]


def _small_block(rng: np.random.Generator) -> list[Surface]:
    return block(rng, 0.12)


def _chair(rng: np.random.Generator) -> list[Surface]:
    cloth = [paint.fabric(colour(rng, 0.05, 0.5)), _DARK, paint.wood(timber(rng))]
    seat = cloth[rng.integers(len(cloth))]
    out = [*box((-0.23, -0.22, 0.42), (0.46, 0.44, 0.07), seat, bottom=True)]
    if rng.random() < 0.8:
        h = rng.uniform(0.3, 0.6)
        back = box((-0.22, 0.0, 0.0), (0.44, 0.06, h), seat, bottom=True)
        A = so3_exp(np.array([-rng.uniform(0.0, 0.25), 0.0, 0.0]))
        out += [moved(s, A, np.array([0.0, 0.2, 0.55])) for s in back]
    if rng.random() < 0.6:
        out += cylinder((0.0, 0.0, 0.06), 0.03, 0.36, _DARK)
        for k in range(5):
            spoke = box((0.0, -0.025, 0.03), (0.3, 0.05, 0.04), _DARK, bottom=True)
            out += [moved(s, so3_exp(UP * (k * 2 * np.pi / 5)), np.zeros(3)) for s in spoke]
    else:
        for x in (-0.21, 0.17):
            for y in (-0.2, 0.16):
                out += box((x, y, 0.0), (0.04, 0.04, 0.42), seat)
    return out


THINGS: tuple[Callable[[np.random.Generator], list[Surface]], ...] = (
    _monitor, _monitor, _keyboard, _laptop, _paper, _paper, _books, _binders, _mug, _bottle, _lamp, _fruit,
    _small_block, _small_block,
)  # fmt: skip
