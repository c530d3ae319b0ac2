# SPDX-License-Identifier: Apache-2.0
"""Render synthetic rooms as training pairs (NNNNN.jpg + NNNNN.png + camera.json + gravity.txt).

The rooms are those of ``data_scripts/training_rooms.py``. Views are chosen for variety,
not for a smooth path: a random point, often one on a table, is looked at from a random
distance and direction, down to almost straight from above, half of the time with a rolled
camera. With ``--furniture`` they are those of ``data_scripts/furnished_rooms.py`` instead, and in a quarter
of the views the camera is where one holds a phone standing or sitting, and looks about. With ``--plain``
the rooms have little texture, and half of the views are of that kind. With ``--by-hand`` every view is as
somebody who stands or sits would film it, nearly upright. ``gravity.txt`` says where down is: lines
``NNNNN x y z``, a view's name and the unit direction of gravity in its camera's frame (x right, y down,
z forward). Same arguments, same files; rooms that are there already are kept.

    python data_scripts/render_training_rooms.py OUT --rooms 30 --views 20 --first-seed 1000
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from furnished_rooms import furnished_scene
from furniture_models import Mesh, Piece, read_catalogues
from mesh_render import MeshRenderer
from training_rooms import UP, plain_scene, varied_scene

from slamdepth.geometry import so3_exp
from slamdepth.io import write_text
from slamdepth.synth.render import Renderer
from slamdepth.types import Camera

WIDTH, HEIGHT = 336, 252
TEXEL_M = 0.004
BLANK = 1.25  # a plain room's view of smaller relief is a piece of wall, which tells nothing
PLAIN_HELD, FURNISHED_HELD = 0.5, 0.25  # share of a room's views
SPREAD = 20_000
FEWEST_MATERIALS = 5  # of a furnished room's view
TABLE_M = (0.6, 1.0)  # heights at which things stand on tables


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """``T_world_camera (4, 4)`` of a camera at ``position`` facing ``target``, held upright."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T


def aimed(
    points: np.ndarray, on_tables: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera is and what it looks at: some thing, from any side."""
    at_table = len(on_tables) > 0 and rng.random() < 0.5
    among = on_tables if at_table else points
    target = among[rng.integers(len(among))] + rng.normal(0, 0.25, 3)
    distance = np.exp(rng.uniform(np.log(0.4), np.log(2.0 if at_table else 4.0)))
    steepest = 80.0 if rng.random() < 0.5 else 40.0
    elevation, azimuth = np.radians(rng.uniform(-8.0, steepest)), rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    position = target + distance * direction / np.linalg.norm(direction)
    return position, target


def held(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The same of somebody who films a room."""
    low, high = points.min(axis=0), points.max(axis=0)
    position = np.append(rng.uniform(low[:2], high[:2]), rng.uniform(0.9, 1.8))
    elevation, azimuth = np.radians(rng.normal(-10.0, 13.0)), rng.uniform(-np.pi, np.pi)
    forward = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    return position, position + forward


def filmed(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The same of somebody who stands or sits and films things within reach and beyond.

    How far away a thing is goes with how steeply it is seen, as it does where a camera is held by hand.
    """
    height = rng.normal(1.5, 0.15) if rng.random() < 0.6 else rng.normal(1.15, 0.12)
    if rng.random() < 0.3:
        low, high = points.min(axis=0), points.max(axis=0)
        position = np.append(rng.uniform(low[:2], high[:2]), height)
        elevation, azimuth = np.radians(rng.normal(-10.0, 13.0)), rng.uniform(-np.pi, np.pi)
        return position, position + np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    target = points[rng.integers(len(points))] + rng.normal(0, 0.15, 3)
    distance, azimuth = np.exp(rng.uniform(np.log(0.25), np.log(3.0))), rng.uniform(-np.pi, np.pi)
    position = np.append(target[:2] + distance * np.array([np.cos(azimuth), np.sin(azimuth)]), height)
    return position, target


def spread(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """Points ``(N, 3)`` on a mesh: large triangles more often, though not by their area."""
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]
    weight = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) ** 0.5
    chosen = rng.choice(len(weight), SPREAD, p=weight / weight.sum())
    a, b = np.sort(rng.random((2, SPREAD, 1)), axis=0)
    corners = mesh.corners[chosen]
    return np.asarray(corners[:, 0] * a + corners[:, 1] * (b - a) + corners[:, 2] * (1 - b), dtype=float)


def room_views(
    seed: int,
    count: int,
    focal_px: float,
    *,
    plain: bool = False,
    pieces: Sequence[Piece] = (),
    by_hand: bool = False,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """``count`` views of one room: image ``(H, W, 3)`` uint8 RGB, depth ``(H, W)`` metres, and the
    direction of gravity ``(3,)`` in the camera's frame."""
    camera = Camera(WIDTH, HEIGHT, focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    rng = np.random.default_rng([seed, 11])
    if pieces:
        furnished = furnished_scene(seed, pieces)
        renderer: Renderer | MeshRenderer = MeshRenderer(furnished, camera, seed)
        points = spread(furnished.mesh, rng)
    else:
        scene = plain_scene(seed) if plain else varied_scene(seed)
        renderer = Renderer(scene, camera, TEXEL_M, seed)
        points = np.concatenate([s.points[::8, ::8].reshape(-1, 3) for s in scene.surfaces])
    often_held = PLAIN_HELD if plain else FURNISHED_HELD if pieces else 0.0
    on_tables = points[(points[:, 2] > TABLE_M[0]) & (points[:, 2] < TABLE_M[1])]
    low, high = points.min(axis=0), points.max(axis=0)
    views: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for _ in range(60 * count):
        if len(views) == count:
            break
        is_held = by_hand or (often_held > 0 and rng.random() < often_held)
        if by_hand:
            position, target = filmed(points, rng)
        else:
            position, target = held(points, rng) if is_held else aimed(points, on_tables, rng)
        if (position < low + 0.25).any() or (position > high - 0.2).any():
            continue
        rolled = not is_held and rng.random() < 0.5
        roll = rng.uniform(-60.0, 60.0) if rolled else rng.normal(0.0, 5.0)
        T_world_camera = look_at(position, target, UP)
        T_world_camera[:3, :3] @= so3_exp(np.array([0.0, 0.0, np.radians(roll)]))
        depth = renderer.depth(T_world_camera)
        known = depth[(depth > 0) & np.isfinite(depth)]
        if len(known) < depth.size or np.percentile(known, 1) < 0.2 or known.max() > 12:
            continue
        if often_held and np.percentile(known, 95) < BLANK * np.percentile(known, 5):
            continue
        if isinstance(renderer, MeshRenderer) and renderer.materials_seen(T_world_camera) < FEWEST_MATERIALS:
            continue
        colour, depth = renderer.render(T_world_camera)
        noise = rng.normal(0, rng.uniform(0, 3), colour.shape)
        down = -T_world_camera[:3, :3].T @ UP
        views.append((np.clip(colour + noise, 0, 255).astype(np.uint8), depth, down))
    return views


def write_gravity(folder: Path) -> None:
    """``gravity.txt`` of what the rooms' notes say: a view's name and the direction of gravity in its camera.

    Rooms of earlier runs count too, since their views are still there.

    Raises:
        ValueError: a room was rendered before notes said so.
    """
    rooms = sorted(int(note.stem[1:]) for note in folder.glob(".[0-9]*.done"))
    notes = [folder / f".{room:05d}.done" for room in rooms]
    for room, note in zip(rooms, notes, strict=True):
        if not note.read_text(encoding="utf-8") and (folder / f"{room * 1000:05d}.png").exists():
            raise ValueError(f"{note}: does not say where down is; delete it to render the room again")
    lines = "".join(note.read_text(encoding="utf-8") for note in notes)
    write_text(folder / "gravity.txt", lines)


def main() -> None:
    """Render what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--focal-px", type=float, default=265.0, help=f"at {WIDTH} x {HEIGHT} pixels")
    parser.add_argument("--plain", action="store_true", help="little texture, half of it as held by hand")
    parser.add_argument(
        "--by-hand", action="store_true", help="every view as somebody who stands or sits would film it"
    )
    parser.add_argument("--furniture", type=Path, metavar="DIR",
                        help="rooms of these pieces instead, see furniture_models.py")  # fmt: skip
    arguments = parser.parse_args()
    if arguments.furniture and arguments.plain:
        parser.error("--plain repaints the rooms without --furniture; leave one of them out")
    pieces = read_catalogues(arguments.furniture) if arguments.furniture else []
    if arguments.furniture and not pieces:
        parser.error(f"--furniture {arguments.furniture}: no catalogue with models in a folder of it; "
                     "data_scripts/furniture_models.py says how to get them")  # fmt: skip
    folder, focal_px = arguments.output, arguments.focal_px
    folder.mkdir(parents=True, exist_ok=True)
    about = {"width": WIDTH, "height": HEIGHT, "fx": focal_px, "fy": focal_px,
             "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2, "depth_unit_m": 0.001}  # fmt: skip
    (folder / "camera.json").write_text(json.dumps(about), encoding="utf-8")
    for room in range(arguments.rooms):
        done = folder / f".{room:05d}.done"
        if not done.exists():
            views = room_views(
                arguments.first_seed + room, arguments.views, focal_px,
                plain=arguments.plain, pieces=pieces, by_hand=arguments.by_hand,
            )  # fmt: skip
            lines = []
            for index, (image, depth, down) in enumerate(views):
                name = folder / f"{room * 1000 + index:05d}"
                lines.append(f"{name.name} {down[0]:.6f} {down[1]:.6f} {down[2]:.6f}\n")
                cv2.imwrite(f"{name}.png", np.clip(np.round(depth * 1000), 0, 65535).astype(np.uint16))
                cv2.imwrite(f"{name}.jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])
            write_text(done, "".join(lines))
        print(f"room {room + 1} of {arguments.rooms}", flush=True)
    try:
        write_gravity(folder)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
