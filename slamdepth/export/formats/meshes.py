# SPDX-License-Identifier: Apache-2.0
"""Meshes: PLY, OBJ and GLB."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from slamdepth.errors import InputError
from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.export.scene import ExportScene
from slamdepth.export.upright import y_up
from slamdepth.mapping.mesh import Mesh
from slamdepth.open3d_loader import import_open3d


@register_format
class PlyFormat(ExportFormat):
    """``mesh.ply`` and ``cloud.ply``."""

    name = "ply"
    about = "mesh and measured points with colours and normals, for MeshLab, CloudCompare, Open3D, Blender"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        scene = request.scene
        files = [path for path in (scene.mesh, scene.cloud) if path is not None]
        if not files:
            raise _no_mesh(scene)
        for path in files:
            shutil.copyfile(path, folder / path.name)
        return ("World frame of the run.",)


@register_format
class ObjFormat(ExportFormat):
    """``mesh.obj``."""

    name = "obj"
    about = "the mesh with the colours after the positions, for MeshLab, Blender, Open3D"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        read_mesh(request.scene).save(folder / "mesh.obj")
        return ("World frame of the run.",)


@register_format
class GlbFormat(ExportFormat):
    """``mesh.glb``."""

    name = "glb"
    about = "the mesh as binary glTF 2.0, for web viewers, phones, game engines, Blender"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        read_mesh(request.scene).save(folder / "mesh.glb", T_viewer_world=y_up(request.scene))
        by = "by how the cameras are held" if request.scene.gravity_w is None else "by the run's gravity"
        return (f"Vertices are in the world frame of the run; the node turns them y up, {by}.",)


def read_mesh(scene: ExportScene) -> Mesh:
    """The mesh of a run.

    Raises:
        InputError: it has none, or the file is damaged.
    """
    if scene.mesh is None:
        raise _no_mesh(scene)
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        read = o3d.io.read_triangle_mesh(str(scene.mesh))
    vertices, triangles = np.asarray(read.vertices, np.float32), np.asarray(read.triangles, np.int32)
    if len(vertices) == 0 or len(triangles) == 0:
        raise InputError(f"{scene.mesh}: holds no mesh, or is damaged")
    colors = np.asarray(read.vertex_colors, np.float32)
    return Mesh(vertices, triangles, colors if len(colors) == len(vertices) else np.full_like(vertices, 0.5))


def _no_mesh(scene: ExportScene) -> InputError:
    return InputError(f"the run of '{scene.name}' has no mesh to export: run it without --no-mesh")
