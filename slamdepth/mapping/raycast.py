# SPDX-License-Identifier: Apache-2.0
"""Pictures of a mesh by casting rays at it: no graphics card, no window."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.mesh import Mesh
    from slamdepth.types import Camera


_FLAT = 0.75  # share of the light that comes from everywhere; photographs have shades of their own
_GREY, _GREY_FLAT = 0.85, 0.25
_SAMPLES = 2  # rays across a pixel, and down it


def render_mesh(
    mesh: Mesh, camera: Camera, T_world_camera: Floats, background: tuple[int, int, int]
) -> NDArray[np.uint8]:
    """``(H, W, 3)`` RGB picture of ``mesh`` as an ideal camera sees it.

    Triangles that show the camera their back are left out, so one looks into a room through its walls and
    its ceiling. The light comes from the camera. A mesh whose colours are all black has none and is grey.

    Args:
        mesh: in the world frame.
        camera: size and focal length; distortion is left out.
        T_world_camera: ``(4, 4)``.
        background: RGB where nothing is hit.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    o3d = import_open3d()
    shown = np.full((camera.height, camera.width, 3), np.array(background, np.float32) / 255)
    triangles = mesh.triangles[_faces(mesh, T_world_camera[:3, 3])]
    if len(triangles):
        colors = mesh.colors if mesh.colors.any() else None
        # one thread: what two triangles share is then always given to the same one
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(mesh.vertices_m, np.float32)),
            o3d.core.Tensor(triangles.astype(np.uint32)),
        )
        nothing, shown = shown, np.zeros_like(shown)
        for at in np.ndindex(_SAMPLES, _SAMPLES):
            dy, dx = (np.array(at) + 0.5) / _SAMPLES - 0.5
            directions = _directions(camera, T_world_camera[:3, :3], float(dx), float(dy))
            origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), directions.shape)
            rays = np.concatenate([origins, directions], axis=-1)
            hits = {name: values.numpy() for name, values in scene.cast_rays(o3d.core.Tensor(rays)).items()}
            sample = nothing.copy()
            is_hit = np.isfinite(hits["t_hit"])
            corners = triangles[hits["primitive_ids"][is_hit]]
            normals, uv = hits["primitive_normals"][is_hit], hits["primitive_uvs"][is_hit]
            sample[is_hit] = _lit(colors, corners, uv, normals, directions[is_hit])
            shown += sample / np.float32(_SAMPLES**2)
    return np.round(np.clip(shown, 0.0, 1.0) * 255).astype(np.uint8)


def _faces(mesh: Mesh, eye_w: Floats) -> NDArray[np.bool_]:
    """Which triangles show their front to ``eye_w (3,)``."""
    a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
    towards = eye_w.astype(np.float32) - a
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), towards) > 0)


def _directions(camera: Camera, R_world_camera: Floats, dx: float, dy: float) -> NDArray[np.float32]:
    """Unit directions ``(H, W, 3)`` in the world of rays ``dx``, ``dy`` pixels off the pixels' centres."""
    x = (np.arange(camera.width) + dx - camera.cx) / camera.fx
    y = (np.arange(camera.height) + dy - camera.cy) / camera.fy
    grid = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
    grid /= np.linalg.norm(grid, axis=-1, keepdims=True)
    return np.asarray(grid @ R_world_camera.T, np.float32)


def _lit(
    colors: Floats32 | None,
    corners: NDArray[np.int32],
    uv: NDArray[np.float32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> Floats32:
    """Colours ``(N, 3)`` of hits between the ``corners (N, 3)`` of their triangles."""
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / length
    if colors is None:
        return np.repeat((_GREY * (_GREY_FLAT + (1 - _GREY_FLAT) * cosine))[:, None], 3, axis=1)
    u, v = uv[:, :1], uv[:, 1:]
    mixed = (1 - u - v) * colors[corners[:, 0]] + u * colors[corners[:, 1]] + v * colors[corners[:, 2]]
    return np.asarray(mixed * (_FLAT + (1 - _FLAT) * cosine)[:, None])
