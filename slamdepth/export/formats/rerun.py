# SPDX-License-Identifier: Apache-2.0
"""A recording of Rerun: poses over time, images, points, mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import ImageDecodeError, OutputError
from slamdepth.export.formats.meshes import read_mesh
from slamdepth.export.images import ExportImages, ImageMode
from slamdepth.export.points import read_cloud
from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.export.scene import View
from slamdepth.mapping.codec import encode_image
from slamdepth.types import Camera

_FRUSTUM_M = 0.1


@register_format
class RerunFormat(ExportFormat):
    """``scene.rrd``."""

    name = "rerun"
    about = "poses over time with images, points and mesh, for Rerun's viewer"
    has_images = True
    package = ("rerun", "rerun")

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        import rerun as rr

        scene, path = request.scene, folder / "scene.rrd"
        stream = rr.RecordingStream("slamdepth", recording_id=scene.name, send_properties=False)
        try:
            stream.save(path)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{path}: cannot be written: {error}") from error
        _log_static(rr, stream, request)
        times_s = scene.trajectory.timestamps_s.tolist()
        for time_s, T in zip(times_s, scene.trajectory.T_world_camera, strict=True):
            stream.set_time("time", duration=time_s - times_s[0])
            stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        written = _log_images(rr, stream, request, times_s[0] if times_s else 0.0)
        stream.flush()
        stream.disconnect()
        return (
            f"{len(times_s)} poses on the timeline 'time', in seconds from the first; {written} images.",
            "Open it with: rerun scene.rrd",
        )


def _log_static(rr: Any, stream: Any, request: ExportRequest) -> None:
    scene = request.scene
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    path_m = scene.trajectory.T_world_camera[:, :3, 3]
    stream.log("world/path", rr.LineStrips3D([path_m], radii=rr.Radius.ui_points(1.5)), static=True)
    if len(scene.points_m):
        stream.log("world/landmarks", rr.Points3D(scene.points_m, colors=[160, 160, 160]), static=True)
    if scene.cloud is not None:
        points_m, colors = read_cloud(scene.cloud)
        stream.log("world/cloud", rr.Points3D(points_m, colors=colors), static=True)
    if scene.mesh is not None:
        mesh = read_mesh(scene)
        stream.log(
            "world/mesh",
            rr.Mesh3D(
                vertex_positions=mesh.vertices_m,
                triangle_indices=mesh.triangles,
                vertex_normals=mesh.normals(),
                vertex_colors=np.rint(mesh.colors * 255.0).astype(np.uint8),
            ),
            static=True,
        )


def _log_images(rr: Any, stream: Any, request: ExportRequest, start_s: float) -> int:
    """The pinhole and the images of the views; returns how many there are."""
    if request.dataset is None or request.mode is ImageMode.NONE:
        if request.scene.camera is not None:
            stream.log("world/camera", _pinhole(rr, request.scene.camera), static=True)
        return 0
    images, written = request.images(), 0
    stream.log("world/camera", _pinhole(rr, images.camera), static=True)
    for number, view in enumerate(request.scene.views):
        request.tell(number + 1, len(request.scene.views))
        written += _log_image(rr, stream, images, view, start_s)
    return written


def _log_image(rr: Any, stream: Any, images: ExportImages, view: View, start_s: float) -> bool:
    try:
        data = encode_image(images.image(view)).data
    except ImageDecodeError:
        return False
    stream.set_time("time", duration=view.timestamp_s - start_s)
    stream.log("world/camera", rr.EncodedImage(contents=data, media_type="image/jpeg"))
    return True


def _pinhole(rr: Any, camera: Camera) -> Any:
    """Rerun's pixels have their origin at the corner of the image."""
    return rr.Pinhole(
        resolution=[camera.width, camera.height],
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_FRUSTUM_M,
    )
