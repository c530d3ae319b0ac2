# SPDX-License-Identifier: Apache-2.0
"""Light baked into the texture atlas: area lamps with shadows, and ambient light with occlusion."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamdepth.synth.scene import Lamp
from slamdepth.synth.shapes import Surface
from slamdepth.typing import Bools, Floats, Floats32

SPACING_M = 0.04
"""Smallest spacing of the points at which light is computed."""

_AMBIENT = np.array([0.62, 0.60, 0.57])
_AMBIENT_REACH_M = 0.9
_LAMP_SAMPLES = 12
_AMBIENT_SAMPLES = 24


def surface_samples(surface: Surface, spacing_m: float) -> tuple[Floats, Floats]:
    """Points and normals ``(rows, columns, 3)`` evenly spaced over a surface's texture."""
    import cv2

    along, down = surface.size_m
    rows = int(np.clip(np.ceil(down / spacing_m), 3, 128))
    columns = int(np.clip(np.ceil(along / spacing_m), 3, 128))
    grid_rows, grid_columns = surface.points.shape[:2]
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows * (grid_rows - 1),
        (np.arange(columns) + 0.5) / columns * (grid_columns - 1),
        indexing="ij",
    )
    u, v = u.astype(np.float32), v.astype(np.float32)
    points, normals = (
        np.asarray(cv2.remap(grid, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64)
        for grid in (surface.points, surface.normals)
    )
    normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
    return points, normals


def bake(
    raycaster: Any, surfaces: list[Surface], lamps: list[Lamp], texel_m: float, seed: int
) -> list[Floats32]:
    """Irradiance maps ``(rows, columns, 3)`` of all surfaces, in arbitrary linear units.

    Args:
        raycaster: an Open3D ``RaycastingScene`` holding the surfaces that cast shadows.
        surfaces: what is lit.
        lamps: what lights it.
        texel_m: size of the texels to be lit; light is computed no finer than three of them.
        seed: seed of the sampling.
    """
    import cv2

    samples = [surface_samples(surface, max(SPACING_M, 3.0 * texel_m)) for surface in surfaces]
    points = np.concatenate([p.reshape(-1, 3) for p, _ in samples])
    normals = np.concatenate([n.reshape(-1, 3) for _, n in samples])
    points = points + 0.004 * normals
    rng = np.random.default_rng([seed, 3])
    light = np.zeros_like(points)
    for lamp in lamps:
        light += _direct(raycaster, points, normals, lamp, rng)
    light += _ambient(raycaster, points, normals, rng)

    maps, start = [], 0
    for p, _ in samples:
        count = p.shape[0] * p.shape[1]
        patch = light[start : start + count].reshape(p.shape).astype(np.float32)
        smooth = cv2.GaussianBlur(patch, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE)
        maps.append(np.asarray(smooth, np.float32))
        start += count
    return maps


def _direct(raycaster: Any, points: Floats, normals: Floats, lamp: Lamp, rng: np.random.Generator) -> Floats:
    side = int(np.ceil(np.sqrt(_LAMP_SAMPLES)))
    total = np.zeros(len(points))
    for k in range(_LAMP_SAMPLES):
        cell = np.array([k % side, k // side])
        a, b = ((cell + rng.random((len(points), 2))) / side * 2.0 - 1.0).T
        target = lamp.centre + a[:, None] * np.array(lamp.edge_a) + b[:, None] * np.array(lamp.edge_b)
        ray = target - points
        distance2 = np.sum(ray * ray, axis=1)
        cosine = np.sum(normals * ray, axis=1) / np.sqrt(distance2)
        lit = np.flatnonzero(cosine > 0)
        shadowed = occluded(raycaster, points[lit], ray[lit], 0.96)
        # Softened near the lamp, so that a shade does not overexpose its own wall.
        total[lit] += np.where(shadowed, 0.0, cosine[lit] / (0.35 + distance2[lit]))
    return np.asarray(total[:, None] / _LAMP_SAMPLES * np.array(lamp.power))


def _ambient(raycaster: Any, points: Floats, normals: Floats, rng: np.random.Generator) -> Floats:
    open_ = np.zeros(len(points))
    for _ in range(_AMBIENT_SAMPLES):
        # A unit normal plus a point of the unit sphere: cosine-weighted directions.
        sphere = rng.standard_normal((len(points), 3))
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        ray = normals + 0.98 * sphere
        ray *= _AMBIENT_REACH_M / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
        hit = cast_distance(raycaster, points, ray)
        open_ += np.minimum(hit, 1.0) ** 0.6
    return np.asarray((0.30 + 0.70 * open_ / _AMBIENT_SAMPLES)[:, None] * _AMBIENT)


def occluded(raycaster: Any, origins: Floats, rays: Floats, farthest: float) -> Bools:
    """Whether something lies between ``origins (N, 3)`` and ``origins + farthest * rays``."""
    from slamdepth.open3d_loader import import_open3d

    o3d = import_open3d()
    packed = o3d.core.Tensor(np.concatenate([origins, rays], axis=1).astype(np.float32))
    result: Bools = raycaster.test_occlusions(packed, tnear=0.0, tfar=farthest).numpy()
    return result


def cast_distance(raycaster: Any, origins: Floats, rays: Floats) -> Floats32:
    """Distances ``(N,)`` to the first hit, in lengths of the rays."""
    from slamdepth.open3d_loader import import_open3d

    o3d = import_open3d()
    packed = o3d.core.Tensor(np.concatenate([origins, rays], axis=1).astype(np.float32))
    distance: Floats32 = raycaster.cast_rays(packed)["t_hit"].numpy()
    return distance
