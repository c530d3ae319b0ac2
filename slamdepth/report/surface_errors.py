# SPDX-License-Identifier: Apache-2.0
"""Two surfaces coloured by their distance to each other, as PLY files and as one image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.evaluation import Surface
from slamdepth.io import encode_ply, replacing
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.raycast import render_mesh
from slamdepth.report.mesh_images import BACKGROUND, error_colours, overview, write_side_by_side
from slamdepth.report.viewpoints import guessed_gravity
from slamdepth.typing import Floats


def write_error_ply(path: Path, surface: Surface, errors_m: Floats) -> None:
    """Write a surface whose vertices are coloured by ``errors_m (V,)``, NaN where not judged.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    triangles = surface.triangles if len(surface.triangles) else None
    data = encode_ply(surface.vertices_m, error_colours(errors_m), triangles)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_error_image(path: Path, surfaces: list[tuple[Surface, Floats]], cameras: Floats) -> bool:
    """Write an image of the surfaces side by side from above, coloured by their errors.

    Args:
        surfaces: each with the error ``(V,)`` of its vertices; seen as the first one is seen best.
        cameras: poses ``(N, 4, 4)`` of the cameras that saw them, which say what is up.

    Returns:
        False, and no file, where a surface has no triangles.

    Raises:
        OutputError: ``path`` cannot be written.
        SlamdepthError: Open3D is not installed.
    """
    if any(len(surface.triangles) == 0 for surface, _ in surfaces):
        return False
    meshes = [
        Mesh(
            surface.vertices_m,
            surface.triangles.astype(np.int32),
            error_colours(errors_m).astype(np.float32) / np.float32(255.0),
        )
        for surface, errors_m in surfaces
    ]
    wide, T = overview(meshes[0], cameras, guessed_gravity(cameras))
    write_side_by_side(path, [render_mesh(mesh, wide, T, BACKGROUND) for mesh in meshes])
    return True
