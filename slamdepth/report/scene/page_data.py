# SPDX-License-Identifier: Apache-2.0
"""A scene as JSON for the 3D view of a page, see ``templates/scene.js``."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.report.gaps import gap_ends
from slamdepth.report.page import data_address
from slamdepth.report.scene.model import Scene, SceneMap
from slamdepth.report.scene.simplify import simplified
from slamdepth.report.viewpoints import from_above, guessed_gravity, ideal_camera
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.mesh import Mesh

MOST_TRIANGLES = 200_000
"""Triangles of all meshes of a page together: 4.5 MB of it."""

_MOST_POSES = 20_000
_STEPS = 65535  # of a coordinate between the bounds of a mesh: 0.2 mm in a room
_STRAYS = 2.0  # per cent of the points that may lie beyond each bound of what is looked at
VIEW_DEG = 50.0
"""From left to right, in the view from which a scene is seen first."""


def with_small_meshes(scene: Scene, most_triangles: int = MOST_TRIANGLES) -> Scene:
    """The scene with at most so many triangles in all its meshes together, each map its share.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    total = sum(len(one.mesh.triangles) for one in scene.maps if one.mesh is not None)
    if total <= most_triangles:
        return scene
    maps = (
        one
        if one.mesh is None
        else replace(one, mesh=simplified(one.mesh, most_triangles * len(one.mesh.triangles) // total))
        for one in scene.maps
    )
    return replace(scene, maps=tuple(maps))


def scene_json(scene: Scene) -> str:
    """The scene as JSON that may stand in a ``<script>`` element; meshes go in as they are."""
    frames = [frame for n, one in enumerate(scene.maps) for frame in _frames(n, one, scene.start_s)]
    frames.sort(key=lambda frame: float(frame["t"]))
    content = {"aspect": scene.aspect, "maps": [_map(one) for one in scene.maps], "frames": frames}
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def first_view(one: SceneMap) -> tuple[Floats, Floats, Floats, float]:
    """The view from which a map is seen first: from above and behind the camera.

    Returns:
        Eye, target and up ``(3,)`` in the world, and the size of what there is to see in metres.
    """
    poses = one.path.T_world_camera
    path = poses[:, :3, 3]
    gravity = one.gravity_w if one.gravity_w is not None else _gravity(poses)
    points = one.points_m if one.mesh is None else one.mesh.vertices_m[::7].astype(np.float64)
    shown = np.concatenate([points, path, np.zeros((1, 3))])
    low, high = np.percentile(shown, [_STRAYS, 100 - _STRAYS], axis=0)
    size = max(float(np.linalg.norm(high - low)), 0.1)
    middle = (low + high) / 2
    if one.mesh is None or len(path) == 0:
        ahead = np.array([0.0, 0.0, 1.0]) + 0.7 * gravity
        eye = middle - 1.4 * size * ahead / np.linalg.norm(ahead)
        return eye, middle, -gravity, size
    T = from_above(one.mesh, path, gravity, ideal_camera(900, 600, VIEW_DEG))
    eye, ahead = T[:3, 3], T[:3, 2]
    return eye, eye + ahead * max(float((middle - eye) @ ahead), 0.1 * size), -gravity, size


def segments(path: Trajectory) -> Floats:
    """The path as pieces ``(S, 2, 3)`` in metres, without its gaps; at most some ten thousand."""
    points = path.T_world_camera[:, :3, 3]
    pieces = []
    for part in np.split(points, gap_ends(path.timestamps_s)):
        step = max(1, len(points) // _MOST_POSES)
        kept = part[np.unique(np.r_[np.arange(0, len(part), step), len(part) - 1])] if len(part) else part
        pieces.append(np.stack([kept[:-1], kept[1:]], axis=1))
    return np.concatenate(pieces) if pieces else np.zeros((0, 2, 3))


def _gravity(poses: Floats) -> Floats:
    return guessed_gravity(poses) if len(poses) else np.array([0.0, 1.0, 0.0])


def _map(one: SceneMap) -> dict[str, Any]:
    eye, target, up, size = first_view(one)
    return {
        "number": one.number,
        "poses": len(one.path),
        "eye": _rounded(eye),
        "target": _rounded(target),
        "up": _rounded(up),
        "size": round(size, 4),
        "mesh": None if one.mesh is None else _mesh(one.mesh),
        "points": _text(one.points_m.astype("<f4")),
        "path": _text(segments(one.path).astype("<f4")),
        "truth": None if one.truth is None else _text(segments(one.truth).astype("<f4")),
        "keyframes": _text(one.keyframes.T_world_camera[:, :3].astype("<f4")),
        "loops": one.loops.tolist(),
    }


def _frames(n: int, one: SceneMap, start_s: float) -> list[dict[str, Any]]:
    return [
        {
            "map": n,
            "row": thumbnail.row,
            "id": int(one.keyframe_ids[thumbnail.row]),
            "t": round(float(one.keyframes.timestamps_s[thumbnail.row]) - start_s, 4),
            "image": data_address(thumbnail.image, "image/jpeg"),
            "depth": data_address(thumbnail.depth, "image/jpeg"),
        }
        for thumbnail in one.thumbnails
    ]


def _mesh(mesh: Mesh) -> dict[str, Any]:
    """Vertices as steps between the bounds, which halves their size."""
    low = mesh.vertices_m.min(axis=0).astype(np.float64)
    step = np.maximum((mesh.vertices_m.max(axis=0) - low) / _STEPS, 1e-12)
    colors = mesh.colors if mesh.colors.any() else np.full_like(mesh.colors, 0.75)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "vertices": _text(np.round((mesh.vertices_m - low) / step).astype("<u2")),
        "colours": _text(np.round(np.clip(colors, 0.0, 1.0) * 255).astype(np.uint8)),
        "triangles": _text(mesh.triangles.astype("<u4")),
        "count": len(mesh.triangles),
    }


def _text(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _rounded(values: Floats) -> list[float]:
    return [round(float(value), 5) for value in values]
