# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of nerfstudio and instant-ngp, with points for splats to start from.

Cameras have OpenGL axes: x right, y up, z backwards. Pixels have their origin at the upper left corner of the
image. The frame of the file is upright, z up. ``applied_transform`` is the identity on purpose: versions of
nerfstudio disagree whether it applies to the points of ``ply_file_path``. The rotation from the run's world
is in ``slamdepth_T_file_world``, which nerfstudio ignores.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.export.images import ExportImages, ImageMode
from slamdepth.export.points import start_points
from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.export.upright import z_up
from slamdepth.export.view_files import FOLDER, image_name, write_views
from slamdepth.geometry import transform
from slamdepth.io import write_json, write_point_cloud
from slamdepth.typing import Bytes, Floats

POINTS = "points.ply"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@register_format
class NerfstudioFormat(ExportFormat):
    """``transforms.json``, ``images/`` and ``points.ply``."""

    name = "nerfstudio"
    about = "cameras, images and points, for nerfstudio (splatfacto, nerfacto) and instant-ngp"
    has_images = True

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        scene, images = request.scene, request.images()
        written = write_views(request, images, folder)
        landmarks = np.zeros((0, 3)) if written.tracks is None else written.tracks.points_m
        points_m, colors = start_points(scene, (landmarks, written.colors))
        T_file_world = z_up(scene)
        frames = [
            {
                "file_path": f"{FOLDER}/{image_name(number)}",
                "transform_matrix": T_file_world @ view.T_world_camera @ _OPENGL,
                "timestamp_s": view.timestamp_s,
            }
            for number, view in enumerate(scene.views)
            if number not in written.missing
        ]
        document = {**_intrinsics(images), **_frame(T_file_world, scene.gravity_w is not None)}
        lines = [
            f"{len(frames)} images, {len(points_m)} points. Frame of the files: z up"
            + (" by the run's gravity." if scene.gravity_w is not None else ", by how the cameras are held."),
            "slamdepth_T_file_world in transforms.json is the rotation from the run's world to this frame.",
        ]
        if len(points_m):
            document["ply_file_path"] = POINTS
            self._write_points(folder / POINTS, points_m, colors, T_file_world)
        if request.mode is not ImageMode.NONE:
            lines.append("Train on it with: ns-train splatfacto --data FOLDER")
        write_json(folder / "transforms.json", {**document, "frames": frames})
        return tuple(lines)

    @staticmethod
    def _write_points(path: Path, points_m: Floats, colors: Bytes, T_file_world: Floats) -> None:
        write_point_cloud(path, transform(T_file_world, points_m), colors)


def _intrinsics(images: ExportImages) -> dict[str, Any]:
    camera = images.camera
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict(zip(names, camera.distortion, strict=False)),
    }


def _frame(T_file_world: Floats, is_upright: bool) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "applied_transform": np.eye(4)[:3],
        "slamdepth_T_file_world": T_file_world,
    }
    if is_upright:
        facts["orientation_override"] = "none"  # nerfstudio would guess 'up' by the mean of the cameras
    return facts
