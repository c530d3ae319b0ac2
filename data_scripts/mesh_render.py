# SPDX-License-Identifier: Apache-2.0
"""Rendering of a room of triangle meshes: rays by Open3D, area lamps, ambient light with occlusion.

Light is computed only at the points seen in a view, so a room costs nothing before its first view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from furniture_models import Mesh

from slamdepth.open3d_loader import import_open3d
from slamdepth.synth.light import cast_distance, occluded
from slamdepth.synth.scene import Lamp
from slamdepth.types import Camera

_LAMP_SAMPLES = 4
_AMBIENT_SAMPLES = 6
_AMBIENT_REACH_M = 1.0
_SUPERSAMPLING = 2  # colour rays along a pixel side
_LEVELS = 7
_SPARSE = 37
_FEW_RAYS = 8


@dataclass(frozen=True)
class MeshScene:
    """A room: its triangles, lamps and ambient light."""

    mesh: Mesh
    lamps: list[Lamp]
    ambient: np.ndarray


class MeshRenderer:
    """Renders one scene with one camera; ``seed`` is for light sampling and exposure."""

    def __init__(self, scene: MeshScene, camera: Camera, seed: int) -> None:
        o3d = import_open3d()
        self._scene, self._camera = scene, camera
        self._rng = np.random.default_rng([seed, 5])
        corners = scene.mesh.corners
        self._raycaster = o3d.t.geometry.RaycastingScene()
        self._raycaster.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(corners.reshape(-1, 3), np.float32)),
            o3d.core.Tensor(np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)),
        )
        sides = corners[:, 1:] - corners[:, :1]
        normal = np.cross(sides[:, 0], sides[:, 1])
        area2 = np.linalg.norm(normal, axis=1)
        self._normals = normal / np.maximum(area2, 1e-12)[:, None]
        images = [material.image for material in scene.mesh.materials]
        texels = np.array([image.shape[0] * image.shape[1] for image in images])[scene.mesh.material]
        uv = scene.mesh.uv[:, 1:] - scene.mesh.uv[:, :1]
        in_image = np.abs(uv[:, 0, 0] * uv[:, 1, 1] - uv[:, 0, 1] * uv[:, 1, 0]) * texels
        self._texel_m = np.sqrt(np.maximum(area2, 1e-12) / np.maximum(in_image, 1e-9))
        self._levels = [_smaller(image) for image in images]
        self._emission = np.array([material.emission for material in scene.mesh.materials])

    def depth(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Depth along z ``(H, W)`` in metres; infinite where nothing is hit."""
        rays = self._rays(T_world_camera, 1)
        depth: np.ndarray = self._cast(rays)["t_hit"].numpy()
        return depth.reshape(self._camera.height, self._camera.width)

    def materials_seen(self, T_world_camera: np.ndarray) -> int:
        """Number of different materials that more than a few rays of a view hit."""
        rays = self._rays(T_world_camera, 1)[::_SPARSE]
        hit = self._cast(rays)["primitive_ids"].numpy()
        hit = hit[hit < len(self._scene.mesh.material)]
        return int((np.bincount(self._scene.mesh.material[hit]) > _FEW_RAYS).sum())

    def render(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours ``(H, W, 3)`` sRGB 0 to 255 and depth along z ``(H, W)`` in metres."""
        height, width = self._camera.height, self._camera.width
        rays = self._rays(T_world_camera, 1)
        hits = self._cast(rays)
        depth = hits["t_hit"].numpy()
        light = self._light(rays, depth, hits["primitive_ids"].numpy()).reshape(height, width, 3)
        light = cv2.blur(light.astype(np.float32), (3, 3))
        fine = self._cast(self._rays(T_world_camera, _SUPERSAMPLING))
        albedo, glow = self._albedo(
            fine["primitive_ids"].numpy(), fine["primitive_uvs"].numpy(), fine["t_hit"].numpy()
        )
        shape = (height * _SUPERSAMPLING, width * _SUPERSAMPLING)
        light = cv2.resize(light, shape[::-1], interpolation=cv2.INTER_LINEAR)
        linear = albedo.reshape(*shape, 3) ** 2.2
        linear = np.where(glow.reshape(*shape, 1) > 0, linear * glow.reshape(*shape, 1), linear * light)
        colour = self._developed(linear.astype(np.float32))
        colour = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
        return colour * 255, depth.reshape(height, width)

    def _cast(self, rays: np.ndarray) -> Any:
        return self._raycaster.cast_rays(import_open3d().core.Tensor(rays))

    def _rays(self, T_world_camera: np.ndarray, finer: int) -> np.ndarray:
        """Rays ``(N, 6)`` of unit z through ``finer`` points along each pixel side."""
        camera = self._camera
        step = (np.arange(finer) + 0.5) / finer - 0.5
        u = (np.arange(camera.width)[:, None] + step).ravel()
        v = (np.arange(camera.height)[:, None] + step).ravel()
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ T_world_camera[:3, :3].T
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        return np.concatenate([origins, directions], axis=1).astype(np.float32)

    def _light(self, rays: np.ndarray, depth: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Irradiance ``(N, 3)`` at the points hit by the rays."""
        hit = np.isfinite(depth)
        out = np.ones((len(rays), 3))
        directions = rays[hit, 3:]
        normals = self._normals[triangle[hit]]
        normals = np.where(np.sum(normals * directions, axis=1, keepdims=True) > 0, -normals, normals)
        points = rays[hit, :3] + depth[hit, None] * directions + 0.004 * normals
        open_ = np.zeros(len(points))
        for _ in range(_AMBIENT_SAMPLES):
            sphere = self._rng.standard_normal((len(points), 3))
            ray = normals + 0.98 * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
            ray *= _AMBIENT_REACH_M / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
            open_ += np.minimum(cast_distance(self._raycaster, points, ray), 1.0) ** 0.6
        light = (0.25 + 0.75 * open_ / _AMBIENT_SAMPLES)[:, None] * self._scene.ambient
        for lamp in self._scene.lamps:
            shares = np.zeros(len(points))
            for _ in range(_LAMP_SAMPLES):
                a, b = self._rng.uniform(-1, 1, (2, len(points), 1))
                ray = lamp.centre + a * np.array(lamp.edge_a) + b * np.array(lamp.edge_b) - points
                distance2 = np.sum(ray * ray, axis=1)
                cosine = np.sum(normals * ray, axis=1) / np.sqrt(distance2)
                lit = np.flatnonzero(cosine > 0)
                shadowed = occluded(self._raycaster, points[lit], ray[lit], 0.96)
                shares[lit] += np.where(shadowed, 0.0, cosine[lit] / (0.35 + distance2[lit]))
            light = light + shares[:, None] / _LAMP_SAMPLES * np.array(lamp.power)
        out[hit] = light
        return out

    def _albedo(
        self, triangle: np.ndarray, barycentric: np.ndarray, depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """sRGB ``(N, 3)`` and emission ``(N,)`` at the points hit by the rays."""
        mesh = self._scene.mesh
        colour, glow = np.full((len(triangle), 3), 0.8, np.float32), np.zeros(len(triangle), np.float32)
        hit = np.flatnonzero(np.isfinite(depth))
        t = triangle[hit]
        a, b = barycentric[hit, :1], barycentric[hit, 1:]
        uv = mesh.uv[t, 0] * (1 - a - b) + mesh.uv[t, 1] * a + mesh.uv[t, 2] * b
        footprint_m = depth[hit] / (self._camera.fx * _SUPERSAMPLING)
        level = np.log2(np.maximum(footprint_m / self._texel_m[t], 1.0)).round().astype(int)
        group = mesh.material[t] * _LEVELS + np.minimum(level, _LEVELS - 1)
        order = np.argsort(group, kind="stable")
        starts = np.flatnonzero(np.diff(group[order], prepend=-1))
        for chosen in np.split(order, starts[1:]):
            material, at = divmod(int(group[chosen[0]]), _LEVELS)
            image = self._levels[material][min(at, len(self._levels[material]) - 1)]
            colour[hit[chosen]] = _sampled(image, uv[chosen])
            glow[hit[chosen]] = self._emission[material]
        return colour, glow

    def _developed(self, linear: np.ndarray) -> np.ndarray:
        """sRGB 0 to 1 after a random exposure near the right one and tone mapping; highlights clip."""
        middle = float(np.median(linear.mean(axis=-1)))
        exposure = np.exp(self._rng.normal(0.0, 0.45)) * 0.3 / max(middle, 0.01)
        knee = self._rng.uniform(0.0, 0.5)
        x = linear * np.float32(exposure)
        encoded: np.ndarray = np.power(np.clip(x / (1 + knee * x), 0, 1), np.float32(1 / 2.2))
        return encoded.astype(np.float32)


def _smaller(image: np.ndarray) -> list[np.ndarray]:
    """``image`` and its mip levels."""
    out = [image]
    while len(out) < _LEVELS and min(out[-1].shape[:2]) >= 2:
        half = (out[-1].shape[1] // 2, out[-1].shape[0] // 2)
        out.append(cv2.resize(out[-1], half, interpolation=cv2.INTER_AREA).reshape(half[1], half[0], 3))
    return out


def _sampled(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear colours ``(N, 3)`` of a repeating image."""
    height, width = image.shape[:2]
    if height == width == 1:
        return np.broadcast_to(image[0, 0], (len(uv), 3))
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    row, row1, column, column1 = y0 % height, (y0 + 1) % height, x0 % width, (x0 + 1) % width
    upper = image[row, column] * (1 - fx) + image[row, column1] * fx
    lower = image[row1, column] * (1 - fx) + image[row1, column1] * fx
    between: np.ndarray = upper * (1 - fy) + lower * fy
    return between
