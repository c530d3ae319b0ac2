# SPDX-License-Identifier: Apache-2.0
"""Points spread evenly over a surface, and distances of points to a surface."""

from __future__ import annotations

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Floats, Floats32, Ints

_SPACING_M = 0.01
_MOST = 100_000


def even_points(vertices_m: Floats32, triangles: Ints, seed: int) -> Floats:
    """Points ``(N, 3)`` spread evenly over a mesh, or those of a cloud; at most one in each voxel of 1 cm.

    Triangles are chosen by area and points in them uniformly (Osada et al., "Shape distributions", 2002).
    A surface larger than 10 square metres gets 100,000 points, and a larger cloud is thinned to as many.

    Args:
        vertices_m: ``(V, 3)`` metres; those that are not finite are left out of a cloud.
        triangles: ``(T, 3)``; empty for a cloud.
        seed: of the random points.

    Raises:
        DatasetError: the surface is so large that its lengths cannot be metres.
    """
    rng = np.random.default_rng(seed)
    vertices = vertices_m.astype(np.float64)
    if len(triangles) == 0:
        points = _one_per_voxel(vertices[np.isfinite(vertices).all(axis=1)])
        return points if len(points) <= _MOST else points[np.sort(rng.permutation(len(points))[:_MOST])]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    total = float(area.sum())
    if total <= 0:
        return np.zeros((0, 3))
    count = int(np.clip(np.ceil(total / _SPACING_M**2), 1, _MOST))
    chosen = np.searchsorted(np.cumsum(area), rng.uniform(0.0, total, count), side="right")
    chosen = np.minimum(chosen, len(area) - 1)
    root, v = np.sqrt(rng.uniform(size=(count, 1))), rng.uniform(size=(count, 1))
    points = (1 - root) * a[chosen] + root * (1 - v) * b[chosen] + root * v * c[chosen]
    return _one_per_voxel(points)


def distances_m(points: Floats, vertices_m: Floats32, triangles: Ints) -> Floats:
    """Distance ``(N,)`` of ``points (N, 3)`` to the nearest triangle, or to the nearest point of a cloud.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    if len(triangles) == 0:
        from scipy.spatial import cKDTree

        return np.asarray(cKDTree(vertices_m).query(points)[0], np.float64)
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices_m, np.float32)),
        o3d.core.Tensor(triangles.astype(np.uint32)),
    )
    found = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    return np.asarray(found, np.float64)


def _one_per_voxel(points: Floats) -> Floats:
    """The first of ``points (N, 3)`` in each voxel, in the order of voxels, which are near one another."""
    if len(points) == 0:
        return points
    voxels = np.floor((points - points.min(axis=0)) / _SPACING_M).astype(np.int64)
    size = voxels.max(axis=0) + 1
    if float(size[0]) * float(size[1]) * float(size[2]) >= 2**62:
        raise DatasetError(
            f"the surface is {float(np.ptp(points, axis=0).max()):.3g} m across: is it metres?"
        )
    key = (voxels[:, 0] * size[1] + voxels[:, 1]) * size[2] + voxels[:, 2]
    return points[np.unique(key, return_index=True)[1]]
