# SPDX-License-Identifier: Apache-2.0
"""COLMAP's sparse model, in its binary files (``src/colmap/scene/reconstruction_io.cc``).

COLMAP's pixels have their origin at the upper left corner of the image, so that the centre of the first pixel
is (0.5, 0.5); ours is (0, 0). Its poses are ``T_camera_world``, quaternions w x y z.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slamdepth.errors import InputError
from slamdepth.export.images import ImageMode
from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.export.scene import ExportScene
from slamdepth.export.tracks import Tracks
from slamdepth.export.view_files import image_name, write_views
from slamdepth.geometry import invert, rotation_to_quat_xyzw
from slamdepth.types import Camera
from slamdepth.typing import Bytes

_PINHOLE, _OPENCV, _FULL_OPENCV = 1, 4, 6  # numbers of COLMAP's camera models
_CAMERA = 1
_NO_POINT = -1


@register_format
class ColmapFormat(ExportFormat):
    """``sparse/0/{cameras,images,points3D}.bin`` and ``images/``."""

    name = "colmap"
    about = "a sparse model and its images, for COLMAP, 3D Gaussian splatting, gsplat, OpenMVS"
    has_images = True

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        scene, images = request.scene, request.images()
        written = write_views(request, images, folder)
        tracks = written.tracks
        if tracks is None:
            raise InputError(
                "this run kept no landmarks to export: run it again with 'slamdepth run ... --export colmap'"
            )
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        (model / "cameras.bin").write_bytes(_cameras(images.camera))
        (model / "images.bin").write_bytes(_images(scene, tracks))
        (model / "points3D.bin").write_bytes(_points(tracks, written.colors))
        lines = [
            f"{len(scene.views)} images, {len(tracks.points_m)} points, {tracks.observations} observations; "
            f"mean reprojection error {tracks.mean_error_px:.3f} px "
            f"({written.tracked_error_px:.3f} before they were refined in the images).",
            f"{tracks.dropped} observations are left out: more than 4 px (as tracked) off, or hidden.",
        ]
        if written.missing:
            lines.append(f"{len(written.missing)} images do not decode and are missing.")
        if request.mode is not ImageMode.NONE:
            lines.append("Open it with: colmap gui --import_path sparse/0 --image_path images")
        return tuple(lines)


def _cameras(camera: Camera) -> bytes:
    focal_and_centre = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if not camera.is_distorted:
        model, parameters = _PINHOLE, focal_and_centre
    elif not any(camera.distortion[4:]):
        model, parameters = _OPENCV, [*focal_and_centre, *camera.distortion[:4]]
    else:  # k1 k2 p1 p2 k3 k4 k5 k6
        rest = [0.0] * (8 - len(camera.distortion))
        model, parameters = _FULL_OPENCV, [*focal_and_centre, *camera.distortion, *rest]
    head = struct.pack("<QIiQQ", 1, _CAMERA, model, camera.width, camera.height)
    return head + struct.pack(f"<{len(parameters)}d", *parameters)


def _images(scene: ExportScene, tracks: Tracks) -> bytes:
    parts = [struct.pack("<Q", len(scene.views))]
    for number, view in enumerate(scene.views):
        T_camera_world = invert(view.T_world_camera)
        x, y, z, w = rotation_to_quat_xyzw(T_camera_world[:3, :3])
        parts.append(struct.pack("<I7dI", number + 1, w, x, y, z, *T_camera_world[:3, 3], _CAMERA))
        parts.append(image_name(number).encode() + b"\0")
        px, rows = tracks.keypoints_px[number], tracks.rows[number]
        points = np.zeros(len(px), [("px", "<f8", 2), ("point", "<i8")])
        points["px"] = px + 0.5
        points["point"] = np.where(rows >= 0, rows + 1, _NO_POINT)
        parts += [struct.pack("<Q", len(px)), points.tobytes()]
    return b"".join(parts)


def _points(tracks: Tracks, colors: Bytes) -> bytes:
    image = np.concatenate([np.full(len(rows), n + 1) for n, rows in enumerate(tracks.rows)])
    keypoint = np.concatenate([np.arange(len(rows)) for rows in tracks.rows])
    point = np.concatenate(tracks.rows)
    seen = np.flatnonzero(point >= 0)
    seen = seen[np.argsort(point[seen], kind="stable")]
    elements = np.column_stack([image[seen], keypoint[seen]]).astype("<u4")
    ends = np.cumsum(np.bincount(point[seen], minlength=len(tracks.points_m)))
    return struct.pack("<Q", len(tracks.points_m)) + b"".join(_records(tracks, colors, elements, ends))


def _records(tracks: Tracks, colors: Bytes, elements: np.ndarray, ends: np.ndarray) -> Iterable[bytes]:
    start = 0
    for row, end in enumerate(ends.tolist()):
        x, y, z = tracks.points_m[row].tolist()
        r, g, b = colors[row].tolist()
        yield struct.pack("<Q3d3BdQ", row + 1, x, y, z, r, g, b, tracks.error_px[row], end - start)
        yield elements[start:end].tobytes()
        start = end
