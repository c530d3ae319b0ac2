# SPDX-License-Identifier: Apache-2.0
"""Rendering of the synthetic room: rays by Open3D, colours from the lit atlas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.geometry import invert
from slamdepth.open3d_loader import import_open3d
from slamdepth.synth.atlas import Atlas, Place, build_atlas
from slamdepth.synth.light import bake
from slamdepth.synth.scene import Scene
from slamdepth.synth.shapes import Surface
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray


_TAPS = np.array([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)], np.float32)
_EDGE_TAPS = 3  # squared: rays through a pixel on a silhouette


class Renderer:
    """Renders one scene with one camera.

    A pixel's depth is that of the ray through its centre. Its colour is filtered: four
    trilinear texture samples inside a surface, nine rays across a silhouette.

    Args:
        scene: what to render; its light is baked on construction, which takes seconds.
        camera: an undistorted camera.
        texel_m: size of a texel.
        seed: seed of paint and light sampling.
    """

    def __init__(self, scene: Scene, camera: Camera, texel_m: float, seed: int) -> None:
        self._camera = camera
        solid = [surface for surface in scene.surfaces if surface.emission == 0]
        painted, texture_of = _textures(scene.surfaces)
        light = bake(_raycaster(solid), painted, scene.lamps, texel_m, seed)
        self._atlas: Atlas = build_atlas(painted, light, texel_m, seed)
        places = [self._atlas.places[texture] for texture in texture_of]
        self._raycaster = _raycaster(scene.surfaces)
        meshes = [surface.triangles for surface in scene.surfaces]
        self._corners = np.concatenate(
            [s.points.reshape(-1, 3)[t] for s, t in zip(scene.surfaces, meshes, strict=True)]
        )
        texels = [_texels(s, place)[t] for s, place, t in zip(scene.surfaces, places, meshes, strict=True)]
        self._texels = np.concatenate(texels)
        self._surface_of = np.repeat(np.arange(len(meshes)), [len(t) for t in meshes]).astype(np.int32)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        self._x = ((u.ravel() - camera.cx) / camera.fx).astype(np.float32)
        self._y = ((v.ravel() - camera.cy) / camera.fy).astype(np.float32)

    def depth(self, T_world_camera: Floats) -> Floats32:
        """Depth along z ``(H, W)`` in metres."""
        depth, _ = self._cast(T_world_camera, self._x, self._y)
        return depth.reshape(self._camera.height, self._camera.width)

    def render(self, T_world_camera: Floats) -> tuple[Floats32, Floats32]:
        """Colours ``(H, W, 3)`` sRGB 0 to 255 and depth along z ``(H, W)`` in metres."""
        height, width = self._camera.height, self._camera.width
        depth, triangle = self._cast(T_world_camera, self._x, self._y)
        to_texel = self._texel_maps(T_world_camera)
        colour = self._colour(to_texel, triangle, self._x, self._y, _TAPS, 0.5)

        edge = np.flatnonzero(_silhouettes(self._surface_of[triangle].reshape(height, width)))
        if len(edge):
            step = (np.arange(_EDGE_TAPS, dtype=np.float32) + 0.5) / _EDGE_TAPS - 0.5
            dx, dy = (o.ravel() for o in np.meshgrid(step / self._camera.fx, step / self._camera.fy))
            x = (self._x[edge][:, None] + dx).ravel().astype(np.float32)
            y = (self._y[edge][:, None] + dy).ravel().astype(np.float32)
            _, hit = self._cast(T_world_camera, x, y)
            fine = self._colour(to_texel, hit, x, y, np.zeros((1, 2), np.float32), 1.0 / _EDGE_TAPS)
            colour[edge] = fine.reshape(len(edge), -1, 3).mean(axis=1)
        return colour.reshape(height, width, 3), depth.reshape(height, width)

    def _cast(self, T_world_camera: Floats, x: Floats32, y: Floats32) -> tuple[Floats32, Ints]:
        """Depth and triangle of the rays through normalised image points ``(N,)``."""
        o3d = import_open3d()
        R = T_world_camera[:3, :3].astype(np.float32)
        rays = np.empty((len(x), 6), np.float32)
        rays[:, :3] = T_world_camera[:3, 3]
        for axis in range(3):  # rays of unit z: their length at the hit is the depth along z
            rays[:, 3 + axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]
        hits = self._raycaster.cast_rays(o3d.core.Tensor(rays))
        triangle = np.minimum(hits["primitive_ids"].numpy(), len(self._corners) - 1).astype(np.int64)
        return hits["t_hit"].numpy(), triangle

    def _texel_maps(self, T_world_camera: Floats) -> Floats32:
        """Homographies ``(T, 9)`` from normalised image points to texels (relative to the corner 0).

        With the corners Q as columns of M, a ray d meets the triangle's plane at
        barycentric coordinates proportional to ``adj(M) d``; texels are linear in them.
        """
        T_camera_world = invert(T_world_camera)
        q = self._corners @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        adjugate = np.stack(
            [np.cross(q[:, 1], q[:, 2]), np.cross(q[:, 2], q[:, 0]), np.cross(q[:, 0], q[:, 1])], axis=1
        )
        relative = self._texels - self._texels[:, :1]
        H = np.empty((len(q), 3, 3))
        H[:, 0] = np.einsum("tk,tkd->td", relative[..., 0], adjugate)
        H[:, 1] = np.einsum("tk,tkd->td", relative[..., 1], adjugate)
        H[:, 2] = adjugate.sum(axis=1)
        H /= np.maximum(np.abs(H[:, 2]).max(axis=1), 1e-30)[:, None, None]
        return H.reshape(-1, 9).astype(np.float32)

    def _colour(
        self,
        to_texel: Floats32,
        triangle: Ints,
        x: Floats32,
        y: Floats32,
        taps: Floats32,
        footprint: float,
    ) -> Floats32:
        """Colours ``(N, 3)``; ``taps`` in pixels, each averaging ``footprint`` of a pixel's side."""
        h = np.ascontiguousarray(to_texel[triangle].T)
        scale = 1.0 / (h[6] * x + h[7] * y + h[8])
        u = (h[0] * x + h[1] * y + h[2]) * scale
        v = (h[3] * x + h[4] * y + h[5]) * scale
        step_x, step_y = scale / np.float32(self._camera.fx), scale / np.float32(self._camera.fy)
        du_dx, dv_dx = (h[0] - u * h[6]) * step_x, (h[3] - v * h[6]) * step_x
        du_dy, dv_dy = (h[1] - u * h[7]) * step_y, (h[4] - v * h[7]) * step_y
        area2 = np.maximum(du_dx * du_dx + dv_dx * dv_dx, du_dy * du_dy + dv_dy * dv_dy)
        level = 0.5 * np.log2(np.maximum(area2 * np.float32(footprint**2), 1e-12)) + np.float32(0.1)
        origin = self._texels[triangle, 0].astype(np.float32)
        u += origin[:, 0]
        v += origin[:, 1]
        total = np.zeros((len(x), 3), np.float32)
        for ox, oy in taps:
            total += self._atlas.sample(u + ox * du_dx + oy * du_dy, v + ox * dv_dx + oy * dv_dy, level)
        return np.asarray(total / np.float32(len(taps)))


def _textures(surfaces: list[Surface]) -> tuple[list[Surface], list[int]]:
    """The surfaces that get a texture of their own, and for each surface the index of its texture."""
    painted: list[Surface] = []
    of_id: dict[str, int] = {}
    texture_of = []
    for surface in surfaces:
        texture = of_id.get(surface.texture_id) if surface.texture_id is not None else None
        if texture is None:
            texture = len(painted)
            painted.append(surface)
            if surface.texture_id is not None:
                of_id[surface.texture_id] = texture
        texture_of.append(texture)
    return painted, texture_of


def _texels(surface: Surface, place: Place) -> Floats:
    """Texel coordinates ``(rows * columns, 2)`` of a surface's grid points."""
    rows, columns = surface.points.shape[:2]
    x = place.x - 0.5 + np.arange(columns) / (columns - 1) * place.width
    y = place.y - 0.5 + np.arange(rows) / (rows - 1) * place.height
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _raycaster(surfaces: list[Surface]) -> Any:
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    points, triangles, start = [], [], 0
    for surface in surfaces:
        points.append(surface.points.reshape(-1, 3))
        triangles.append(surface.triangles + start)
        start += len(points[-1])
    scene.add_triangles(
        o3d.core.Tensor(np.concatenate(points).astype(np.float32)),
        o3d.core.Tensor(np.concatenate(triangles).astype(np.uint32)),
    )
    return scene


def _silhouettes(surface: NDArray[np.int32]) -> Bools:
    """True at pixels with a direct neighbour on another surface."""
    edge = np.zeros(surface.shape, bool)
    across, down = surface[:, 1:] != surface[:, :-1], surface[1:] != surface[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
