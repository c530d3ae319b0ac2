# SPDX-License-Identifier: Apache-2.0
"""Textured surfaces of the synthetic room: grids of points with a paint.

A shape is one :class:`Surface` or a list of them. A surface is a grid of points ``(rows, columns, 3)`` in
the world (z up, metres), visible from the side of its normals, with the rows running down its texture. Each
has its own rectangle in the texture atlas, unless it shares one by its ``texture_id``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.typing import Floats, Floats32, Ints

Paint = Callable[[np.random.Generator, int, int, float], Floats32]
"""``paint(rng, height, width, texel_m) -> (height, width, 3)`` float32 sRGB 0 to 1."""


@dataclass(frozen=True)
class Surface:
    """One painted patch.

    Attributes:
        points: ``(rows, columns, 3)`` metres.
        size_m: length along a row and down a column.
        paint: makes its texture.
        emission: above 0, the patch emits its texture times this factor and is not lit.
        texel_scale: factor on the texel size, above 1 for surfaces with little detail.
        texture_id: surfaces of one id look the same: they share the texture and the light of the first.
            None is a texture of its own.
    """

    points: Floats
    size_m: tuple[float, float]
    paint: Paint
    emission: float = 0.0
    texel_scale: float = 1.0
    texture_id: str | None = None

    @property
    def normals(self) -> Floats:
        """Unit normals ``(rows, columns, 3)`` at the grid points, towards the visible side."""
        along = np.gradient(self.points, axis=1)
        down = np.gradient(self.points, axis=0)
        normal = np.cross(down, along)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        mean = normal.sum(axis=(0, 1))
        # The normal is undefined at the poles of a sphere: use the mean normal there.
        flat = np.broadcast_to(mean / max(float(np.linalg.norm(mean)), 1e-12), normal.shape)
        return np.where(length > 1e-12, normal / np.maximum(length, 1e-12), flat)

    @property
    def triangles(self) -> Ints:
        """Triangles ``(T, 3)``, indices into the flattened grid of points."""
        rows, columns = self.points.shape[:2]
        corner = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
        upper = np.stack([a, c, b], axis=-1).reshape(-1, 3)
        lower = np.stack([b, c, d], axis=-1).reshape(-1, 3)
        return np.concatenate([upper, lower])


def moved(
    surfaces: Sequence[Surface], offset_m: tuple[float, float, float], *, half_turn: bool = False
) -> list[Surface]:
    """Copies of ``surfaces``, rotated by 180 degrees about the z axis if asked, then translated."""
    turn = np.array([-1.0, -1.0, 1.0]) if half_turn else np.ones(3)
    return [replace(surface, points=surface.points * turn + np.array(offset_m)) for surface in surfaces]


def quad(
    origin: Floats | tuple[float, float, float],
    along: Floats | tuple[float, float, float],
    down: Floats | tuple[float, float, float],
    paint: Paint,
    *,
    emission: float = 0.0,
    texel_scale: float = 1.0,
) -> Surface:
    """A rectangle given by its top left corner; ``down x along`` points towards the viewer."""
    o, a, d = (np.asarray(v, dtype=np.float64) for v in (origin, along, down))
    points = np.array([[o, o + a], [o + d, o + d + a]])
    size = (float(np.linalg.norm(a)), float(np.linalg.norm(d)))
    return Surface(points, size, paint, emission, texel_scale)


def box(
    low: tuple[float, float, float],
    size: tuple[float, float, float],
    paint: Paint | dict[str, Paint],
    *,
    yaw: float = 0.0,
    bottom: bool = False,
    texel_scale: float = 1.0,
) -> list[Surface]:
    """A box given by its lowest corner, rotated by ``yaw`` radians about its vertical centre line.

    ``paint`` may be a dict with the faces ``+x -x +y -y +z -z``, and ``*`` for all others.
    """
    paints = paint if isinstance(paint, dict) else {"*": paint}
    sx, sy, sz = size
    centre = np.array(low) + np.array(size) / 2.0
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    # name: top left corner in half sizes, direction along, direction down
    faces = {
        "+x": ((1, -1, 1), (0, sy, 0), (0, 0, -sz)),
        "-x": ((-1, 1, 1), (0, -sy, 0), (0, 0, -sz)),
        "+y": ((1, 1, 1), (-sx, 0, 0), (0, 0, -sz)),
        "-y": ((-1, -1, 1), (sx, 0, 0), (0, 0, -sz)),
        "+z": ((-1, 1, 1), (sx, 0, 0), (0, -sy, 0)),
    }
    if bottom:
        faces["-z"] = ((-1, -1, -1), (sx, 0, 0), (0, sy, 0))
    half = np.array(size) / 2.0
    return [
        quad(
            centre + R @ (np.array(corner) * half),
            R @ np.array(along, dtype=np.float64),
            R @ np.array(down, dtype=np.float64),
            paints.get(name, paints.get("*", next(iter(paints.values())))),
            texel_scale=texel_scale,
        )
        for name, (corner, along, down) in faces.items()
    ]


def lathe(
    base: tuple[float, float, float], profile: list[tuple[float, float]], paint: Paint, *, segments: int = 40
) -> Surface:
    """A surface of revolution; ``profile`` lists ``(radius, height above base)`` from the top down."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    angle[-1] = 0.0  # close the seam exactly
    radius, height = (np.array(column) for column in zip(*profile, strict=True))
    points = np.empty((len(profile), segments + 1, 3))
    points[..., 0] = base[0] + radius[:, None] * np.cos(angle)
    points[..., 1] = base[1] + radius[:, None] * np.sin(angle)
    points[..., 2] = base[2] + height[:, None]
    length = float(np.sum(np.hypot(np.diff(radius), np.diff(height))))
    return Surface(points, (float(2.0 * np.pi * radius.max()), length), paint)


def cylinder(
    base: tuple[float, float, float], radius: float, height: float, side: Paint, top: Paint | None = None
) -> list[Surface]:
    """An upright cylinder with a lid."""
    body = lathe(base, [(radius, height), (radius, 0.0)], side)
    lid = lathe(base, [(1e-4, height), (radius, height)], top or side)
    return [body, lid]


def ellipsoid(
    centre: tuple[float, float, float], radii: tuple[float, float, float], paint: Paint, *, power: float = 1.0
) -> Surface:
    """An ellipsoid; ``power`` below 1 makes it cushion-like (a superellipsoid)."""
    latitude = np.linspace(np.pi / 2, -np.pi / 2, 25)[:, None]
    longitude = np.linspace(0.0, 2.0 * np.pi, 49)[None, :].copy()
    longitude[0, -1] = 0.0

    def curve(value: Floats) -> Floats:
        return np.sign(value) * np.abs(value) ** power

    points = np.empty((25, 49, 3))
    points[..., 0] = centre[0] + radii[0] * curve(np.cos(latitude)) * curve(np.cos(longitude))
    points[..., 1] = centre[1] + radii[1] * curve(np.cos(latitude)) * curve(np.sin(longitude))
    points[..., 2] = centre[2] + radii[2] * curve(np.sin(latitude)) * np.ones_like(longitude)
    size = (2.0 * np.pi * max(radii[:2]), np.pi * max(radii))
    return Surface(points, size, paint)


def leaf(
    root: tuple[float, float, float], heading: float, length: float, width: float, rise: float, paint: Paint
) -> list[Surface]:
    """A drooping blade, painted on both sides."""
    t = np.linspace(0.0, 1.0, 9)
    middle = np.stack(
        [
            root[0] + np.cos(heading) * length * t * (0.5 + 0.5 * t),
            root[1] + np.sin(heading) * length * t * (0.5 + 0.5 * t),
            root[2] + rise * (1.6 * t - 0.9 * t**2.5),
        ],
        axis=1,
    )
    half = 0.5 * width * (np.sin(np.pi * (0.08 + 0.90 * t)) ** 0.8)[:, None]
    side = np.array([-np.sin(heading), np.cos(heading), 0.0])
    points = np.stack([middle - half * side, middle, middle + half * side], axis=1)
    points[:, 1, 2] -= 0.15 * half[:, 0]
    return [Surface(points, (width, length), paint), Surface(points[:, ::-1], (width, length), paint)]
