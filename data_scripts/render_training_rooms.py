# SPDX-License-Identifier: Apache-2.0
"""Render synthetic rooms as training pairs (NNNNN.jpg + NNNNN.png + camera.json + gravity.txt).

    python data_scripts/render_training_rooms.py OUT --rooms 30 --views 20 --first-seed 1000

The rooms are those of ``data_scripts/training_rooms.py``. Views are chosen for variety and do not form a
path: the camera looks at a random point, often one on a table, from a random distance and direction, up to
almost straight from above, and is rolled in half of the views. Options:

* ``--furniture DIR``: rooms of ``data_scripts/furnished_rooms.py``. In a quarter of the views the camera is
  held by a person who stands or sits.
* ``--simple``: rooms with little texture. Half of the views are of that kind.
* ``--by-hand``: all views are those of a hand-held video, nearly upright.

``gravity.txt`` has lines ``NNNNN x y z``: the name of a view and the unit direction of gravity in its camera
frame (x right, y down, z forward). The same arguments give the same files. Rooms that exist are kept.
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
from training_rooms import UP, simple_scene, varied_scene

from slamdepth.geometry import look_at, so3_exp
from slamdepth.io import write_text
from slamdepth.synth.render import Renderer
from slamdepth.types import Camera
from slamdepth.typing import Floats, Floats32

WIDTH, HEIGHT = 336, 252
TEXEL_M = 0.004
MIN_DEPTH_RATIO = 1.25  # far over near; a view with less shows a piece of wall
SIMPLE_STANDING, FURNISHED_STANDING = 0.5, 0.25  # share of a room's views
MESH_POINTS = 20_000
MIN_MATERIALS = 5  # in a view of a furnished room
TABLE_M = (0.6, 1.0)  # range of heights of things on tables


def aimed(points: Floats, on_tables: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Position and target ``(3,)`` of a camera that looks at a random thing from any side."""
    at_table = len(on_tables) > 0 and rng.random() < 0.5
    among = on_tables if at_table else points
    target = among[rng.integers(len(among))] + rng.normal(0, 0.25, 3)
    distance = np.exp(rng.uniform(np.log(0.4), np.log(2.0 if at_table else 4.0)))
    steepest = 80.0 if rng.random() < 0.5 else 40.0
    elevation, azimuth = np.radians(rng.uniform(-8.0, steepest)), rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    position = target + distance * direction / np.linalg.norm(direction)
    return position, target


def standing(points: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Position and target ``(3,)`` of a camera held by a person who stands or sits and looks around."""
    low, high = points.min(axis=0), points.max(axis=0)
    position = np.append(rng.uniform(low[:2], high[:2]), rng.uniform(0.9, 1.8))
    elevation, azimuth = np.radians(rng.normal(-10.0, 13.0)), rng.uniform(-np.pi, np.pi)
    forward = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    return position, position + forward


def handheld(points: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Position and target ``(3,)`` of a camera held by a person who takes a video of things near and far.

    The distance of a thing goes with the angle at which it is seen, as for a real hand-held camera.
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


def sampled_points(mesh: Mesh, rng: np.random.Generator) -> Floats:
    """Random points ``(N, 3)`` on a mesh; the weight of a triangle is the square root of its area."""
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]
    weight = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) ** 0.5
    chosen = rng.choice(len(weight), MESH_POINTS, p=weight / weight.sum())
    a, b = np.sort(rng.random((2, MESH_POINTS, 1)), axis=0)
    corners = mesh.corners[chosen]
    return np.asarray(corners[:, 0] * a + corners[:, 1] * (b - a) + corners[:, 2] * (1 - b), dtype=float)


def open_room(
    seed: int, camera: Camera, rng: np.random.Generator, *, simple: bool, pieces: Sequence[Piece]
) -> tuple[Renderer | MeshRenderer, Floats]:
    """The renderer of room ``seed``, and points ``(N, 3)`` of its surfaces to look at."""
    if pieces:
        furnished = furnished_scene(seed, pieces)
        return MeshRenderer(furnished, camera, seed), sampled_points(furnished.mesh, rng)
    scene = simple_scene(seed) if simple else varied_scene(seed)
    points = np.concatenate([s.points[::8, ::8].reshape(-1, 3) for s in scene.surfaces])
    return Renderer(scene, camera, TEXEL_M, seed), points


def random_pose(
    points: Floats, rng: np.random.Generator, *, standing_share: float, by_hand: bool
) -> Floats | None:
    """``T_world_camera (4, 4)`` of a random view; None if it is outside of the room.

    Args:
        points: ``(N, 3)`` points of the room.
        standing_share: share of views from where a person holds a camera.
        by_hand: all views are of a hand-held video.
    """
    is_upright = by_hand or (standing_share > 0 and rng.random() < standing_share)
    if by_hand:
        position, target = handheld(points, rng)
    elif is_upright:
        position, target = standing(points, rng)
    else:
        on_tables = points[(points[:, 2] > TABLE_M[0]) & (points[:, 2] < TABLE_M[1])]
        position, target = aimed(points, on_tables, rng)
    if (position < points.min(axis=0) + 0.25).any() or (position > points.max(axis=0) - 0.2).any():
        return None
    is_rolled = not is_upright and rng.random() < 0.5
    roll = rng.uniform(-60.0, 60.0) if is_rolled else rng.normal(0.0, 5.0)
    T_world_camera = look_at(position, target, -UP)
    T_world_camera[:3, :3] @= so3_exp(np.array([0.0, 0.0, np.radians(roll)]))
    return T_world_camera


def is_informative(renderer: Renderer | MeshRenderer, T_world_camera: Floats, *, reject_walls: bool) -> bool:
    """True if a view has depth everywhere, in range, and does not show too little.

    Args:
        reject_walls: reject views with almost no depth range, such as a piece of wall.
    """
    depth = renderer.depth(T_world_camera)
    known = depth[(depth > 0) & np.isfinite(depth)]
    if len(known) < depth.size or np.percentile(known, 1) < 0.2 or known.max() > 12:
        return False
    if reject_walls and np.percentile(known, 95) < MIN_DEPTH_RATIO * np.percentile(known, 5):
        return False
    return not isinstance(renderer, MeshRenderer) or renderer.materials_seen(T_world_camera) >= MIN_MATERIALS


def room_views(
    seed: int,
    count: int,
    focal_px: float,
    *,
    simple: bool = False,
    pieces: Sequence[Piece] = (),
    by_hand: bool = False,
) -> list[tuple[np.ndarray, Floats32, Floats]]:
    """Up to ``count`` views of room ``seed``.

    Args:
        focal_px: focal length.
        simple: the room has little texture.
        pieces: furniture; if given, the room is furnished with it.
        by_hand: all views are of a hand-held video.

    Returns:
        For each view the image ``(H, W, 3)`` uint8 RGB, the depth ``(H, W)`` in metres, and the unit
        direction of gravity ``(3,)`` in the camera frame.
    """
    camera = Camera(WIDTH, HEIGHT, focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    rng = np.random.default_rng([seed, 11])
    renderer, points = open_room(seed, camera, rng, simple=simple, pieces=pieces)
    standing_share = SIMPLE_STANDING if simple else FURNISHED_STANDING if pieces else 0.0
    views: list[tuple[np.ndarray, Floats32, Floats]] = []
    for _ in range(60 * count):
        if len(views) == count:
            break
        T_world_camera = random_pose(points, rng, standing_share=standing_share, by_hand=by_hand)
        if T_world_camera is None:
            continue
        if not is_informative(renderer, T_world_camera, reject_walls=standing_share > 0):
            continue
        colour, depth = renderer.render(T_world_camera)
        noise = rng.normal(0, rng.uniform(0, 3), colour.shape)
        gravity = -T_world_camera[:3, :3].T @ UP
        views.append((np.clip(colour + noise, 0, 255).astype(np.uint8), depth, gravity))
    return views


def write_gravity(folder: Path) -> None:
    """Write ``gravity.txt`` from the notes of all rooms in ``folder``, also of earlier runs.

    Raises:
        ValueError: the note of a room with views has no gravity.
    """
    rooms = sorted(int(note.stem[1:]) for note in folder.glob(".[0-9]*.done"))
    notes = [folder / f".{room:05d}.done" for room in rooms]
    for room, note in zip(rooms, notes, strict=True):
        if not note.read_text(encoding="utf-8") and (folder / f"{room * 1000:05d}.png").exists():
            raise ValueError(f"{note}: has no directions of gravity; delete it to render the room again")
    lines = "".join(note.read_text(encoding="utf-8") for note in notes)
    write_text(folder / "gravity.txt", lines)


def main(argv: list[str] | None = None) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--focal-px", type=float, default=265.0, help=f"at {WIDTH} x {HEIGHT} pixels")
    parser.add_argument("--simple", action="store_true", help="rooms with little texture")
    parser.add_argument("--by-hand", action="store_true", help="all views as in a hand-held video")
    parser.add_argument("--furniture", type=Path, metavar="DIR",
                        help="rooms furnished with these models, see furniture_models.py")  # fmt: skip
    arguments = parser.parse_args(argv)
    if arguments.furniture and arguments.simple:
        parser.error("--simple is for rooms without --furniture; leave one of them out")
    pieces = read_catalogues(arguments.furniture) if arguments.furniture else []
    if arguments.furniture and not pieces:
        parser.error(f"--furniture {arguments.furniture}: no catalogue with models in a folder of it; "
                     "see data_scripts/furniture_models.py")  # fmt: skip
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
                simple=arguments.simple, pieces=pieces, by_hand=arguments.by_hand,
            )  # fmt: skip
            lines = []
            for index, (image, depth, gravity) in enumerate(views):
                name = folder / f"{room * 1000 + index:05d}"
                lines.append(f"{name.name} {gravity[0]:.6f} {gravity[1]:.6f} {gravity[2]:.6f}\n")
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
