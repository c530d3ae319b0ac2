# SPDX-License-Identifier: Apache-2.0
"""Meshes and point clouds from files, by Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.evaluation.surface import Surface
from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Bools

MESH_ENDINGS = (".ply", ".obj", ".stl", ".off")
CLOUD_ENDINGS = (".ply", ".pcd", ".xyz", ".pts")


def is_surface_file(path: Path) -> bool:
    """Whether the name of ``path`` ends as a file that :func:`read_surface` reads."""
    return path.suffix.lower() in {*MESH_ENDINGS, *CLOUD_ENDINGS}


def read_surface(path: Path) -> Surface:
    """Read a mesh, or a point cloud from a file without triangles. Lengths are taken to be metres.

    Vertices that are not finite are dropped, with the triangles at them.

    Raises:
        DatasetError: the file is missing, of another kind, or holds no point.
        SlamdepthError: Open3D is not installed.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: no such file")
    if not is_surface_file(path):
        known = ", ".join(dict.fromkeys([*MESH_ENDINGS, *CLOUD_ENDINGS]))
        raise DatasetError(f"{path}: a mesh or point cloud must end in one of {known}")
    o3d = import_open3d()
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if path.suffix.lower() in MESH_ENDINGS:
            mesh = o3d.io.read_triangle_mesh(str(path))
            vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64)
        if len(triangles) == 0 and path.suffix.lower() in CLOUD_ENDINGS:
            vertices = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    finite: Bools = np.asarray(np.isfinite(vertices).all(axis=1))
    if not finite.any():
        raise DatasetError(f"{path}: holds no surface that can be read: damaged, empty, or of another format")
    if finite.all():
        return Surface(vertices.astype(np.float32), triangles.reshape(-1, 3))
    renamed = np.cumsum(finite) - 1
    kept = triangles[finite[triangles].all(axis=1)]
    return Surface(vertices[finite].astype(np.float32), renamed[kept].reshape(-1, 3))
