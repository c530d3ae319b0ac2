# SPDX-License-Identifier: Apache-2.0
"""Images of a mesh by ray casting; needs neither a graphics card nor a window."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.mesh import Mesh
    from slamdepth.types import Camera


_FLAT = 0.75  # share of ambient light; the colours, taken from photographs, are shaded already
_GREY, _GREY_FLAT = 0.85, 0.25
_SAMPLES = 2  # per pixel and axis


def render_mesh(
    mesh: Mesh,
    camera: Camera,
    T_world_camera: Floats,
    background: tuple[int, int, int],
    samples: int = _SAMPLES,
) -> NDArray[np.uint8]:
    """Render ``mesh`` as a pinhole camera sees it: ``(H, W, 3)`` uint8 RGB.

    Back-facing triangles are left out, so that the camera looks into a room through its walls and ceiling.
    The light comes from the camera. A mesh whose colours are all black is taken to have none and is grey.

    Args:
        mesh: in the world frame.
        camera: size and intrinsics; distortion is ignored.
        T_world_camera: ``(4, 4)``.
        background: RGB, 0 to 255, where no triangle is hit.
        samples: rays per pixel and axis.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    o3d = import_open3d()
    shown = np.full((camera.height, camera.width, 3), np.array(background, np.float32) / 255)
    triangles = mesh.triangles[_faces(mesh, T_world_camera[:3, 3])]
    if len(triangles):
        colors = mesh.colors if mesh.colors.any() else None
        # one thread: a hit on an edge is then always assigned to the same triangle
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(mesh.vertices_m, np.float32)),
            o3d.core.Tensor(triangles.astype(np.uint32)),
        )
        nothing, shown = shown, np.zeros_like(shown)
        for at in np.ndindex(samples, samples):
            dy, dx = (np.array(at) + 0.5) / samples - 0.5
            directions = _directions(camera, T_world_camera[:3, :3], float(dx), float(dy))
            origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), directions.shape)
            rays = np.concatenate([origins, directions], axis=-1)
            hits = {name: values.numpy() for name, values in scene.cast_rays(o3d.core.Tensor(rays)).items()}
            sample = nothing.copy()
            is_hit = np.isfinite(hits["t_hit"])
            corners = triangles[hits["primitive_ids"][is_hit]]
            normals, uv = hits["primitive_normals"][is_hit], hits["primitive_uvs"][is_hit]
            sample[is_hit] = _lit(colors, corners, uv, normals, directions[is_hit])
            shown += sample / np.float32(samples**2)
    return np.asarray(np.round(np.clip(shown, 0.0, 1.0) * 255), np.uint8)


def _faces(mesh: Mesh, eye_w: Floats) -> NDArray[np.bool_]:
    """Mask ``(T,)`` of the triangles whose front faces ``eye_w (3,)``."""
    a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
    towards = eye_w.astype(np.float32) - a
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), towards) > 0)


def _directions(camera: Camera, R_world_camera: Floats, dx: float, dy: float) -> NDArray[np.float32]:
    """Unit directions ``(H, W, 3)`` in the world of rays ``dx``, ``dy`` pixels off the pixel centres."""
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
    """Shaded colours ``(N, 3)`` of the hits at ``uv (N, 2)`` on triangles with ``corners (N, 3)``."""
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / length
    if colors is None:
        return np.repeat((_GREY * (_GREY_FLAT + (1 - _GREY_FLAT) * cosine))[:, None], 3, axis=1)
    u, v = uv[:, :1], uv[:, 1:]
    mixed = (1 - u - v) * colors[corners[:, 0]] + u * colors[corners[:, 1]] + v * colors[corners[:, 2]]
    return np.asarray(mixed * (_FLAT + (1 - _FLAT) * cosine)[:, None])
