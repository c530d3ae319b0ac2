# SPDX-License-Identifier: Apache-2.0
"""Open3D's own RGB-D reconstruction, with the sensor's depth: at given poses, and with its own odometry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.errors import ImageDecodeError
from slamdepth.evaluation import Surface
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.sensor_surface import SensorFrame, fuse_sensor
from slamdepth.mapping.undistorted import undistorted_depth
from slamdepth.open3d_loader import import_open3d
from slamdepth.types import Frame, Trajectory

_VOXEL_M = 0.02
_MAX_DEPTH_M = 4.0
_MILLIMETRES = 1000.0


def fused_at_poses(dataset: Dataset, keyframes: Sequence[Keyframe], scale: float) -> Surface | None:
    """Sensor depth of the keyframes' frames in Open3D's voxel block grid, at their poses.

    Args:
        scale: of the map's lengths to true metres. The surface is in lengths of the map.
    """
    frames = []
    for keyframe in keyframes:
        try:
            frame = dataset.read(keyframe.frame.index, with_depth=True)
        except ImageDecodeError:
            continue
        if frame.depth_m is not None:
            T = keyframe.T_world_camera.copy()
            T[:3, 3] *= scale
            frames.append(SensorFrame(frame.depth_m, frame.camera, T))
    seen = fuse_sensor(frames, _VOXEL_M, _MAX_DEPTH_M, behind_m=0.0, least_views=1)
    return _surface(seen.vertices_m / np.float32(scale), seen.triangles)


def open3d_slam(dataset: Dataset) -> tuple[Surface | None, Trajectory]:
    """Open3D's dense SLAM (``open3d.t.pipelines.slam``) on all frames, frame to model, on the CPU.

    A frame that it cannot place keeps the pose of the one before, and is not fused.
    """
    o3d = import_open3d()
    device, camera = o3d.core.Device("CPU:0"), dataset.camera
    model = o3d.t.pipelines.slam.Model(_VOXEL_M, 16, 20_000, o3d.core.Tensor(np.eye(4)), device)
    K = o3d.core.Tensor(camera.K)
    given, seen = (o3d.t.pipelines.slam.Frame(camera.height, camera.width, K, device) for _ in range(2))
    T = np.eye(4)
    times_s: list[float] = []
    poses: list[Any] = []
    for frame in dataset.frames(with_depth=True):
        if frame.depth_m is None:
            continue
        _give(o3d, given, frame)
        is_placed = not poses
        if poses:
            try:
                found = model.track_frame_to_model(given, seen, _MILLIMETRES, _MAX_DEPTH_M, 0.07)
                T = T @ found.transformation.cpu().numpy()
                is_placed = True
            except RuntimeError:  # "singular": too little structure
                is_placed = False
        model.update_frame_pose(len(poses), o3d.core.Tensor(T))
        if is_placed:
            model.integrate(given, _MILLIMETRES, _MAX_DEPTH_M, 8.0)
        model.synthesize_model_frame(seen, _MILLIMETRES, 0.1, _MAX_DEPTH_M, 8.0, False)
        times_s.append(frame.timestamp_s)
        poses.append(T.copy())
    mesh = model.extract_trianglemesh(3.0).to_legacy()
    surface = _surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles))
    return surface, Trajectory(np.array(times_s), np.array(poses))


def _give(o3d: Any, given: Any, frame: Frame) -> None:
    """Hand one image with its depth to Open3D, undistorted."""
    import cv2

    assert frame.depth_m is not None
    camera, image = frame.camera, frame.image_rgb
    if camera.is_distorted:
        image = np.asarray(cv2.undistort(image, camera.K, camera.distortion_array), np.uint8)
    depth = np.round(undistorted_depth(frame.depth_m, camera) * _MILLIMETRES)
    raw = np.where(depth < 65535, depth, 0).astype(np.uint16)
    given.set_data_from_image("depth", o3d.t.geometry.Image(o3d.core.Tensor(raw)))
    given.set_data_from_image("color", o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image))))


def _surface(vertices: Any, triangles: Any) -> Surface | None:
    if len(triangles) == 0:
        return None
    return Surface(vertices.astype(np.float32), triangles.astype(np.int64).reshape(-1, 3))
