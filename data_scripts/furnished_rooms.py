# SPDX-License-Identifier: Apache-2.0
"""Rooms furnished from catalogues of a thousand pieces, each at its real size.

A room has a theme (office, living room, kitchen, bedroom, or anything). Furniture stands along the walls
and in the middle, with things on it. There are workplaces as in ``data_scripts/training_rooms.py``, people,
and windows, doors and prints on the walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from furniture_models import Material, Mesh, Piece, joined, load_mesh
from mesh_render import MeshScene
from training_rooms import THINGS, UP, any_paint, block, colour, grey, timber, workplace

from slamdepth.geometry import so3_exp
from slamdepth.synth import paint, prints
from slamdepth.synth.scene import Lamp
from slamdepth.synth.shapes import Paint, Surface, quad

_TEXEL_M = 0.004
_LARGEST_TEXELS = 512
_TILE_M = 2.0  # a wall's texture repeats after it
_INDOORS = ("Living room", "Office", "Kitchen", "Bedroom", "Bathroom", "Miscellaneous", "Lights")
_THEMES = (
    {"Office": 6.0, "Living room": 2.0, "Miscellaneous": 2.0, "Lights": 1.0},
    {"Living room": 6.0, "Miscellaneous": 2.0, "Lights": 1.0, "Bedroom": 0.5},
    {"Kitchen": 6.0, "Living room": 2.0, "Miscellaneous": 1.0},
    {"Bedroom": 6.0, "Living room": 1.5, "Lights": 1.0, "Miscellaneous": 1.0},
    dict.fromkeys(_INDOORS, 1.0),
)
_OTHER_WEIGHT = 0.15  # of categories that a theme does not name
_PEOPLE = 0.05  # share of the furniture
_SMALL_M = 0.45  # pieces up to this size stand on others
_LARGEST_M, _TALLEST_M = 3.5, 2.5
_CARRIES_M = (0.35, 1.15)
_HUNG_M = 0.3
_TRIES = 12
_OVERLAP_M = 0.1
_WORKPLACE = Piece("workplace", "Office", Path(), (1.8, 1.4, 1.3), 0.0, None)
_WALLS = ((0.0, (0, 1)), (np.pi, (0, -1)), (np.pi / 2, (-1, 0)), (-np.pi / 2, (1, 0)))
"""Rotations that put the back (+y) of a piece to a wall, and the direction of that wall."""


def furnished_scene(seed: int, pieces: Sequence[Piece]) -> MeshScene:
    """Room number ``seed``, z up, with a corner of its floor at the origin."""
    rng = np.random.default_rng([seed, 19])
    room = np.array([rng.uniform(2.6, 7.0), rng.uniform(2.4, 6.0), rng.uniform(2.3, 3.1)])
    meshes, lamps = _shell(room, rng)
    stock = _Stock(pieces, rng)
    taken: list[np.ndarray] = []
    for _ in range(int(rng.integers(0, 4))):
        put = _placed(_WORKPLACE, room, taken, rng.random() < 0.5, rng)
        if put is not None:
            meshes += [_mesh(s, rng).moved(*put) for s in workplace(rng)]
    for _ in range(int(np.clip(room[0] * room[1] * rng.uniform(0.5, 1.4), 5, 28))):
        found = stock.large()
        if found is None:
            continue
        piece, mesh = found
        likes_walls = piece.size_m[2] > 1.2 or piece.elevation_m > _HUNG_M
        put = _placed(piece, room, taken, rng.random() < (0.8 if likes_walls else 0.5), rng)
        if put is None:
            continue
        A, place = put
        meshes.append(_varied(mesh, rng).moved(A * rng.uniform(0.95, 1.05), place))
        if piece.top_m is not None and _CARRIES_M[0] < piece.top_m < _CARRIES_M[1]:
            meshes += _laden(piece.size_m[:2], piece.top_m, A, place, stock, rng)
    for _ in range(int(rng.integers(0, 6))):
        place = np.append(rng.uniform(0.1, 0.9, 2) * room[:2], 0.0)
        meshes += [_mesh(s, rng).moved(np.eye(3), place) for s in block(rng, 0.3)]
    return MeshScene(joined(meshes), lamps, np.array([0.62, 0.60, 0.57]) * rng.uniform(0.5, 1.2))


class _Stock:
    """The pieces available to a room of a random theme."""

    def __init__(self, pieces: Sequence[Piece], rng: np.random.Generator) -> None:
        theme = _THEMES[rng.integers(len(_THEMES))]
        self._rng = rng
        indoors = [
            p for p in pieces
            if p.category in _INDOORS and max(p.size_m) < _LARGEST_M and p.size_m[2] < _TALLEST_M
        ]  # fmt: skip
        self._small = [p for p in indoors if max(p.size_m) <= _SMALL_M and p.elevation_m <= _HUNG_M]
        large = [p for p in indoors if max(p.size_m) > _SMALL_M]
        people = [p for p in pieces if p.category == "Characters" and _SMALL_M < p.size_m[2] < 2.0]
        chance = np.array([theme.get(p.category, _OTHER_WEIGHT) for p in large])
        chance = np.append(
            chance / max(chance.sum(), 1e-9), np.full(len(people), _PEOPLE / max(len(people), 1))
        )
        self._large, self._chance = [*large, *people], chance / max(chance.sum(), 1e-9)

    def large(self) -> tuple[Piece, Mesh] | None:
        """A random piece that stands on the floor or hangs; None if it has no mesh or there is none."""
        return (
            _loaded(self._large[self._rng.choice(len(self._large), p=self._chance)]) if self._large else None
        )

    def small(self) -> tuple[Piece, Mesh] | None:
        """A random piece that stands on others; None if it has no mesh or there is none."""
        return _loaded(self._small[self._rng.integers(len(self._small))]) if self._small else None


def _loaded(piece: Piece) -> tuple[Piece, Mesh] | None:
    mesh = load_mesh(piece)
    return None if mesh is None else (piece, mesh)


def _placed(
    piece: Piece, room: np.ndarray, taken: list[np.ndarray], at_wall: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation ``(3, 3)`` and position ``(3,)`` at a free place, added to ``taken``; None if not found."""
    is_hung = piece.elevation_m > _HUNG_M
    size = np.array(piece.size_m)
    for _ in range(_TRIES):
        if at_wall or is_hung:
            angle, wall = _WALLS[rng.integers(len(_WALLS))]
            side = np.array(wall)
            half = size[:2] / 2 if side[0] == 0 else size[1::-1] / 2
            xy = rng.uniform(half, np.maximum(room[:2] - half, half + 1e-3))
            at_side = np.where(side > 0, room[:2] - half - 0.01, half + 0.01)
            xy = np.where(side == 0, xy, at_side)
        else:
            angle = rng.uniform(-np.pi, np.pi) if rng.random() < 0.5 else rng.integers(4) * np.pi / 2
            c, s = abs(np.cos(angle)), abs(np.sin(angle))
            half = np.array([[c, s], [s, c]]) @ size[:2] / 2
            xy = rng.uniform(half, np.maximum(room[:2] - half, half + 1e-3))
        if (xy + half > room[:2] + 0.05).any():
            continue
        low = max(min(piece.elevation_m, room[2] - size[2]), 0.0) if is_hung else 0.0
        box = np.array([[*(xy - half), low], [*(xy + half), low + size[2]]])
        if all((np.minimum(box[1], t[1]) - np.maximum(box[0], t[0]) < _OVERLAP_M).any() for t in taken):
            taken.append(box)
            return so3_exp(UP * angle), np.append(xy, low)
    return None


def _laden(
    size_m: tuple[float, ...],
    top_m: float,
    A: np.ndarray,
    place: np.ndarray,
    stock: _Stock,
    rng: np.random.Generator,
) -> list[Mesh]:
    """Things with space between them on a top of ``size_m`` at ``place``, rotated by ``A``."""
    out: list[Mesh] = []
    spots: list[tuple[np.ndarray, float]] = []
    wanted = int(rng.integers(0, 5) + rng.poisson(9 * size_m[0] * size_m[1]))
    for _ in range(3 * wanted):
        if len(spots) >= wanted:
            break
        found = stock.small() if rng.random() < 0.55 else None
        if found is not None:
            thing, mesh = found
            meshes, radius = [_varied(mesh, rng)], max(thing.size_m[:2]) / 2
        else:
            meshes, radius = [_mesh(s, rng) for s in THINGS[rng.integers(len(THINGS))](rng)], 0.16
        reach = np.array(size_m) / 2 - 0.6 * radius
        if (reach <= 0).any():
            continue
        spot = rng.uniform(-reach, reach)
        if any(np.linalg.norm(spot - other) < 0.75 * (radius + r) for other, r in spots):
            continue
        spots.append((spot, radius))
        turn = so3_exp(UP * (rng.normal(0, 0.5) if rng.random() < 0.6 else rng.uniform(-np.pi, np.pi)))
        at = place + A @ np.append(spot, top_m)
        out += [m.moved(A @ turn * rng.uniform(0.95, 1.05), at) for m in meshes]
    return out


def _varied(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """``mesh`` with some of its materials tinted or replaced by a single colour."""

    def varied(material: Material) -> Material:
        kind = rng.random()
        if kind < 0.25:
            tint = np.exp(rng.normal(0, 0.25, 3))
            return Material(np.clip(material.image * tint, 0.02, 0.97).astype(np.float32))
        if kind < 0.35:
            return Material(np.array(colour(rng), np.float32).reshape(1, 1, 3))
        return material

    return replace(mesh, materials=tuple(varied(material) for material in mesh.materials))


def _mesh(surface: Surface, rng: np.random.Generator) -> Mesh:
    """A painted surface of ``slamdepth synth`` as triangles."""
    along, down = (int(np.clip(s / _TEXEL_M, 4, _LARGEST_TEXELS)) for s in surface.size_m)
    image = surface.paint(rng, down, along, surface.size_m[0] / along)
    return _textured(surface, image, np.array([[0.01, 0.01], [0.99, 0.99]]))


def _tiled(surface: Surface, rng: np.random.Generator) -> Mesh:
    """A wall as triangles with a repeating texture."""
    side = int(_TILE_M / _TEXEL_M)
    image = surface.paint(rng, side, side, _TEXEL_M)
    return _textured(surface, image, np.array([[0.0, 0.0], surface.size_m]) / _TILE_M)


def _textured(surface: Surface, image: np.ndarray, uv: np.ndarray) -> Mesh:
    """``surface`` as triangles; ``uv (2, 2)`` are the texture coordinates of its first and last corner."""
    rows, columns = surface.points.shape[:2]
    (u_0, v_0), (u_1, v_1) = uv
    u, v = np.linspace(u_0, u_1, columns), np.linspace(v_0, v_1, rows)
    at = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    triangles = surface.triangles
    material = Material(np.asarray(image, np.float32), surface.emission)
    corners = surface.points.reshape(-1, 3)[triangles]
    return Mesh(corners, at[triangles], np.zeros(len(triangles), np.int32), (material,))


@dataclass(frozen=True)
class _Wall:
    """A wall from floor to ceiling: its start, and unit vectors along it and into the room."""

    start: np.ndarray
    along: np.ndarray
    inwards: np.ndarray
    length_m: float

    def patch(
        self,
        low_m: float,
        size_m: tuple[float, float],
        what: Paint,
        rng: np.random.Generator,
        emission: float = 0.0,
    ) -> Surface:
        """A flat surface at a random place along the wall, its lower edge at ``low_m``."""
        at = rng.uniform(0.05, max(self.length_m - size_m[0] - 0.05, 0.06))
        corner = self.start + at * self.along + UP * (low_m + size_m[1]) + 0.01 * self.inwards
        return replace(quad(corner, size_m[0] * self.along, -UP * size_m[1], what), emission=emission)


def _walls(room: np.ndarray) -> list[_Wall]:
    x, y, _ = room
    corners = [np.array(c) for c in ((0.0, 0.0, 0.0), (x, 0.0, 0.0), (x, y, 0.0), (0.0, y, 0.0))]
    walls = []
    for end, start in zip(corners, [*corners[1:], corners[0]], strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        walls.append(_Wall(start, along, np.cross(along, UP), float(np.linalg.norm(end - start))))
    return walls


def _shell(room: np.ndarray, rng: np.random.Generator) -> tuple[list[Mesh], list[Lamp]]:
    """Floor, ceiling, walls with windows, doors and prints; and the lamps."""
    x, y, z = room
    floors = (paint.wood(timber(rng), plank_m=rng.uniform(0.06, 0.2)), paint.fabric(colour(rng, 0.1, 0.6)),
              paint.plain(grey(rng), contrast=0.06),
              paint.checker(grey(rng), grey(rng), float(rng.uniform(0.2, 0.5))))  # fmt: skip
    usual = paint.plain(grey(rng, 0.55, 0.97), contrast=rng.uniform(0.0, 0.03))
    out = [
        _tiled(quad((0, y, 0), (x, 0, 0), (0, -y, 0), floors[rng.integers(len(floors))]), rng),
        _tiled(quad((0, 0, z), (x, 0, 0), (0, y, 0), paint.plain(grey(rng, 0.75, 0.95))), rng),
    ]
    lamps = []
    for wall in _walls(room):
        others = (paint.plaster(colour(rng, 0.5, 0.95)), paint.wood(timber(rng)), paint.brick(),
                  paint.wallpaper(colour(rng, 0.5, 0.9), colour(rng, 0.3, 0.8)))  # fmt: skip
        chosen = usual if rng.random() < 0.7 else others[rng.integers(len(others))]
        whole = quad(wall.start + UP * z, wall.along * wall.length_m, -UP * z, chosen)
        out.append(_tiled(whole, rng))
        if rng.random() < 0.35 and wall.length_m > 1.5:
            meshes, lamp = _window(wall, rng)
            out += meshes
            lamps.append(lamp)
        for _ in range(int(rng.poisson(1.2))):
            size = (float(rng.uniform(0.2, 1.0)), float(rng.uniform(0.25, 0.9)))
            what = prints.poster() if rng.random() < 0.6 else any_paint(rng)
            out.append(_mesh(wall.patch(float(rng.uniform(0.9, 1.5)), size, what, rng), rng))
        if rng.random() < 0.3 and wall.length_m > 1.2:
            leaf = prints.door_leaf(colour(rng, 0.3, 0.95))
            out.append(_mesh(wall.patch(0.0, (0.9, 2.05), leaf, rng), rng))
    for _ in range(int(rng.integers(1, 4))):
        power = np.array([3.0, 2.75, 2.35]) * np.exp(rng.normal(-0.3, 0.5)) * np.exp(rng.normal(0, 0.1, 3))
        u, v = rng.uniform(0.2, 0.8, 2) * room[:2]
        a, b = rng.uniform(0.1, 0.5, 2)
        lamps.append(Lamp((u, v, z - 0.12), (a, 0.0, 0.0), (0.0, b, 0.0), tuple(power)))
    return out, lamps


def _window(wall: _Wall, rng: np.random.Generator) -> tuple[list[Mesh], Lamp]:
    """A bright pane in a frame, and the lamp of its daylight."""
    size = (float(rng.uniform(0.8, min(2.4, wall.length_m - 0.4))), float(rng.uniform(0.8, 1.4)))
    pane = wall.patch(0.85, size, prints.landscape(), rng, emission=float(rng.uniform(0.8, 2.5)))
    middle = pane.points.mean(axis=(0, 1))
    frame = middle + 1.1 * (pane.points - middle) - 0.004 * wall.inwards
    day = np.array([3.4, 3.7, 4.2]) * size[0] * size[1] * rng.uniform(0.2, 1.4)
    lamp = Lamp(
        tuple(middle + 0.06 * wall.inwards), tuple(0.45 * size[0] * wall.along), (0.0, 0.0, 0.45 * size[1]),
        tuple(day),
    )  # fmt: skip
    white = replace(pane, points=frame, paint=paint.plain((0.85, 0.85, 0.83)), emission=0.0)
    return [_mesh(white, rng), _mesh(pane, rng)], lamp
