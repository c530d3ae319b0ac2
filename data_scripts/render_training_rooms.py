# SPDX-License-Identifier: Apache-2.0
"""Render synthetic rooms as training pairs (NNNNN.jpg + NNNNN.png + camera.json).

The rooms are those of ``slamdepth synth`` taken apart: walls stretched, furniture moved,
turned, resized or left out, small things strewn over table and floor. Views are chosen
for variety, not for a smooth path: a random point is looked at from a random distance
and direction. Same arguments, same files.

    python data_scripts/render_training_rooms.py OUT --rooms 30 --views 20 --first-seed 1000
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from slamdepth.datasets import synth_furniture as furniture
from slamdepth.datasets import synth_paint as paint
from slamdepth.datasets import synth_print as printed
from slamdepth.datasets import synth_scene
from slamdepth.datasets.synth_render import Renderer
from slamdepth.datasets.synth_shapes import Surface, box, cylinder, ellipsoid
from slamdepth.geometry import so3_exp
from slamdepth.types import Camera

WIDTH, HEIGHT, FOCAL_PX = 336, 252, 265.0
TEXEL_M = 0.004
UP = np.array([0.0, 0.0, 1.0])
GROUPS = ("desk", "desk", "bookshelf", "sofa", "cabinet", "rug_and_table", "plant", "corners")


def varied_scene(seed: int) -> synth_scene.Scene:
    """The synthetic room of ``seed`` with another shape, other furniture places and clutter."""
    rng = np.random.default_rng([seed, 12])
    base = synth_scene.build_scene(seed, "rich")
    stretch = np.array([rng.uniform(0.7, 1.4), rng.uniform(0.75, 1.4), rng.uniform(0.9, 1.2)])
    shell = [*synth_scene._shell(rng), *synth_scene._window(), *synth_scene._door(),
             *synth_scene._pictures(rng)]  # fmt: skip
    surfaces = [moved(s, np.diag(stretch), np.zeros(3)) for s in shell]
    room = np.array([5.0, 4.0, 2.6]) * stretch
    for name in GROUPS:
        if rng.random() < 0.25:
            continue
        group = list(getattr(furniture, name)(rng))
        if name == "desk":
            group += clutter(rng, (1.0, 3.32), (2.6, 3.9), 0.735, int(rng.integers(2, 16)), 0.12)
        points = np.concatenate([s.points.reshape(-1, 3) for s in group])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 * [1, 1, 0]
        A = so3_exp(UP * rng.uniform(-np.pi, np.pi)) * rng.uniform(0.85, 1.2)
        place = np.append(rng.uniform(0.15, 0.85, 2) * room[:2], 0.0)
        if rng.random() < 0.35:  # against its wall, where it belongs
            A, place = np.eye(3), middle * stretch
        surfaces += [moved(s, A, place - A @ middle) for s in group]
    surfaces += clutter(rng, (0.3, 0.3), tuple(room[:2] - 0.3), 0.0, int(rng.integers(0, 12)), 0.3)
    lamps = [
        replace(
            lamp,
            centre=tuple(np.array(lamp.centre) * stretch * [1, 1, 0.98]),
            power=tuple(np.array(lamp.power) * np.exp(rng.normal(0, 0.4)) * np.exp(rng.normal(0, 0.1, 3))),
        )
        for lamp in base.lamps
    ]
    return synth_scene.Scene(surfaces, lamps)


def moved(surface: Surface, A: np.ndarray, t: np.ndarray) -> Surface:
    """``surface`` after the linear map ``A`` and the shift ``t``; its texture stretches along."""
    return replace(surface, points=surface.points @ A.T + t)


def clutter(
    rng: np.random.Generator, low: tuple, high: tuple, z: float, count: int, size_m: float
) -> list[Surface]:
    """Boxes, books, mugs and balls standing on the plane ``z`` between two corners."""
    out: list[Surface] = []
    for _ in range(count):
        x, y = rng.uniform(low, high)
        colour = tuple(float(c) for c in rng.uniform(0.05, 0.95, 3))
        paints = [paint.plain(colour), printed.book(colour), printed.cardboard(), printed.poster(),
                  paint.fabric(colour), paint.wood(colour), printed.page()]  # fmt: skip
        chosen = paints[rng.integers(len(paints))]
        kind = rng.random()
        sx, sy, sz = size_m * np.exp(rng.uniform(-0.9, 0.9, 3))
        if kind < 0.5:
            out += box((x - sx / 2, y - sy / 2, z), (sx, sy, sz), chosen, yaw=rng.uniform(0, np.pi))
        elif kind < 0.8:
            out += cylinder((x, y, z), 0.4 * sx, sz, chosen)
        else:
            out.append(ellipsoid((x, y, z + sz / 2), (sx / 2, sy / 2, sz / 2), chosen))
    return out


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """``T_world_camera (4, 4)`` of a camera at ``position`` facing ``target``, held upright."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T


def room_views(seed: int, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """``count`` pairs of image ``(H, W, 3)`` uint8 RGB and depth ``(H, W)`` metres of one room."""
    camera = Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    rng = np.random.default_rng([seed, 11])
    scene = varied_scene(seed)
    renderer = Renderer(scene, camera, TEXEL_M, seed)
    points = np.concatenate([s.points[::8, ::8].reshape(-1, 3) for s in scene.surfaces])
    low, high = points.min(axis=0), points.max(axis=0)
    up = UP
    views: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(40 * count):
        if len(views) == count:
            break
        target = points[rng.integers(len(points))] + rng.normal(0, 0.25, 3)
        distance = np.exp(rng.uniform(np.log(0.5), np.log(3.5)))
        direction = rng.normal(0, 1, 3)
        direction -= up * (direction @ up)
        direction = direction / np.linalg.norm(direction) + up * np.tan(rng.uniform(-0.1, 0.8))
        position = target + distance * direction / np.linalg.norm(direction)
        if (position < low + 0.25).any() or (position > high - 0.25).any():
            continue
        T_world_camera = look_at(position, target, up)
        depth = renderer.depth(T_world_camera)
        known = depth[(depth > 0) & np.isfinite(depth)]
        if len(known) < depth.size or np.percentile(known, 1) < 0.25 or known.max() > 12:
            continue
        colour, depth = renderer.render(T_world_camera)
        noise = rng.normal(0, rng.uniform(0, 3), colour.shape)
        views.append((np.clip(colour + noise, 0, 255).astype(np.uint8), depth))
    return views


def main() -> None:
    """Render what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=1000)
    arguments = parser.parse_args()
    folder = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    about = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL_PX, "fy": FOCAL_PX,
             "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2, "depth_unit_m": 0.001}  # fmt: skip
    (folder / "camera.json").write_text(json.dumps(about), encoding="utf-8")
    for room in range(arguments.rooms):
        for index, (image, depth) in enumerate(room_views(arguments.first_seed + room, arguments.views)):
            name = folder / f"{room * 1000 + index:05d}"
            cv2.imwrite(f"{name}.png", np.clip(np.round(depth * 1000), 0, 65535).astype(np.uint16))
            cv2.imwrite(f"{name}.jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])
        print(f"room {room + 1} of {arguments.rooms}", flush=True)


if __name__ == "__main__":
    main()
