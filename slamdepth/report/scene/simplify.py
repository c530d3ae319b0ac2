# SPDX-License-Identifier: Apache-2.0
"""A mesh with fewer triangles, for pages and viewers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.mesh import Mesh
from slamdepth.open3d_loader import import_open3d

if TYPE_CHECKING:
    from slamdepth.typing import Floats32

_FEW = 4  # times as many triangles as wanted: more are thinned out on a grid first, ten times as fast


def simplified(mesh: Mesh, most_triangles: int) -> Mesh:
    """The mesh with at most about ``most_triangles``; the same one where it has no more.

    Edges are collapsed where the surface changes least (Garland and Heckbert, "Surface simplification using
    quadric error metrics", SIGGRAPH 1997); colours are averaged.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    if len(mesh.triangles) <= most_triangles:
        return mesh
    o3d = import_open3d()
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices_m.astype(np.float64)),
        o3d.utility.Vector3iVector(mesh.triangles),
    )
    made.vertex_colors = o3d.utility.Vector3dVector(mesh.colors.astype(np.float64))
    if len(mesh.triangles) > _FEW * most_triangles:
        factor = np.sqrt(len(mesh.triangles) / (_FEW * most_triangles))
        made = made.simplify_vertex_clustering(_mean_edge_m(mesh) * float(factor))
    made = made.simplify_quadric_decimation(most_triangles)
    made.remove_unreferenced_vertices()
    colors = np.clip(np.asarray(made.vertex_colors), 0.0, 1.0)
    return Mesh(
        np.asarray(made.vertices, np.float32),
        np.asarray(made.triangles, np.int32),
        np.asarray(colors, np.float32),
        mesh.notes,
    )


def _mean_edge_m(mesh: Mesh) -> float:
    some = mesh.triangles[:: max(1, len(mesh.triangles) // 10_000)]
    edges: Floats32 = mesh.vertices_m[some[:, 0]] - mesh.vertices_m[some[:, 1]]
    return float(np.linalg.norm(edges, axis=1).mean())
