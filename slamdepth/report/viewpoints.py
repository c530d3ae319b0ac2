# SPDX-License-Identifier: Apache-2.0
"""Viewpoints for images of a mesh, chosen from the mesh and the path of the camera."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import look_at
from slamdepth.report.axes import level_axes
from slamdepth.types import Camera
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.mesh import Mesh


_ELEVATION = math.radians(35.0)
_AZIMUTHS = 36
_MARGIN = 0.92  # of the image is filled
_STRAYS = 1.0  # per cent of the mesh that may lie beyond each edge
_POSES = 30
_BACK, _UP = 0.35, 0.1  # of the distance to what a camera saw
_STEEPEST = 0.94  # cosine to gravity, beyond which an image's horizon means nothing
_MOST = 20_000  # triangles and vertices that are looked at
_SPREAD = 0.02  # mean square of x axes out of a plane, beyond which cameras were not held level


def ideal_camera(width: int, height: int, across_deg: float) -> Camera:
    """An ideal camera of ``width`` x ``height`` pixels that sees ``across_deg`` from left to right."""
    focal = width / 2 / math.tan(math.radians(across_deg) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def guessed_gravity(T_world_camera: Floats) -> Floats:
    """Direction of gravity ``(3,)`` in the world, assuming that the cameras ``(N, 4, 4)`` were held level.

    The x axes of level cameras lie in a level plane, however the cameras are turned and tipped (Brown and
    Lowe, "Automatic panoramic image stitching using invariant features", IJCV 2007). Where the axes define
    no plane, the result is the mean of the y axes; where that vanishes, the first camera's y axis.
    """
    x, y = T_world_camera[:, :3, 0], T_world_camera[:, :3, 1].mean(axis=0)
    if np.linalg.norm(y) < 0.1:
        return np.array([0.0, 1.0, 0.0])
    y = y / np.linalg.norm(y)
    mean_squares, axes = np.linalg.eigh(x.T @ x / len(x))
    down = axes[:, 0] * (1.0 if axes[:, 0] @ y > 0 else -1.0)
    is_level = mean_squares[0] < _SPREAD < mean_squares[1] and down @ y > 0.5
    return np.asarray(down if is_level else y)


def from_above(mesh: Mesh, path_w: Floats, gravity_w: Floats, camera: Camera) -> Floats:
    """``T_world_camera (4, 4)`` obliquely from above, from the side that shows most of the mesh's front.

    That side is behind the camera which saw it. All of mesh and path is in the image, except for strays.

    Args:
        path_w: ``(N, 3)`` positions of the camera in the world.
        gravity_w: ``(3,)`` unit direction of gravity in the world.
    """
    corner, normals = _triangles(mesh)
    right, down, forward = level_axes(gravity_w)
    angles = np.linspace(0.0, 2 * np.pi, _AZIMUTHS, endpoint=False)[:, None]
    level = np.cos(angles) * forward + np.sin(angles) * right
    ahead = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * down
    shown = np.maximum(-normals @ ahead.T, 0.0).sum(axis=0)
    return _fitted(corner, path_w, look_at(np.zeros(3), ahead[int(shown.argmax())], down), camera)


def over_the_shoulder(mesh: Mesh, T_world_camera: Floats, gravity_w: Floats, camera: Camera) -> Floats | None:
    """``T_world_camera (4, 4)``, level, a step behind the pose that sees most of the mesh's front.

    Args:
        T_world_camera: ``(N, 4, 4)`` poses of the path to choose from.
        gravity_w: ``(3,)`` unit direction of gravity in the world.

    Returns:
        None where every pose looks straight down or up, or at nothing.
    """
    corner, normals = _triangles(mesh)
    best, most = None, 0.0
    for i in np.unique(np.linspace(0, len(T_world_camera) - 1, _POSES).round().astype(int)):
        pose = T_world_camera[i]
        ahead = pose[:3, 2]
        z = (corner - pose[:3, 3]) @ ahead
        seen = z[_inside(corner, pose, camera)]
        if len(seen) == 0 or abs(ahead @ gravity_w) > _STEEPEST:
            continue
        reach = float(np.median(seen))
        eye = pose[:3, 3] - reach * (_BACK * ahead + _UP * gravity_w)
        T = look_at(eye, pose[:3, 3] + reach * ahead, gravity_w)
        towards = eye - corner
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        front = np.maximum(np.einsum("ij,ij->i", normals, towards), 0.0)
        shown = float(front[_inside(corner, T, camera)].sum())
        if shown > most:
            best, most = T, shown
    return best


def _triangles(mesh: Mesh) -> tuple[Floats, Floats]:
    """A corner ``(N, 3)`` of some triangles, and their normals, of twice their area in length."""
    some = mesh.triangles[:: -(-len(mesh.triangles) // _MOST)]
    a, b, c = (mesh.vertices_m[some[:, k]].astype(np.float64) for k in range(3))
    return a, np.cross(b - a, c - a)


def _inside(points: Floats, T_world_camera: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Which ``points (N, 3)`` of the world are in the image."""
    p = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    half = np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
    return np.asarray((np.abs(p[:, :2]) < half * p[:, 2:]).all(axis=1))


def _fitted(points: Floats, path_w: Floats, T_world_camera: Floats, camera: Camera) -> Floats:
    """The camera moved, not turned, as near as possible with both in the image."""
    T: Floats = T_world_camera.copy()
    p, path = points @ T[:3, :3], path_w @ T[:3, :3]
    half = np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2 * _MARGIN
    # a point is left of the right edge of a camera at (x, z) where p_x - half p_z < x - half z
    high = np.percentile(p[:, :2] - half * p[:, 2:], 100 - _STRAYS, axis=0)
    low = np.percentile(p[:, :2] + half * p[:, 2:], _STRAYS, axis=0)
    high = np.maximum(high, (path[:, :2] - half * path[:, 2:]).max(axis=0))
    low = np.minimum(low, (path[:, :2] + half * path[:, 2:]).min(axis=0))
    T[:3, 3] = T[:3, :3] @ [*(low + high) / 2, ((low - high) / 2 / half).min()]
    return T
