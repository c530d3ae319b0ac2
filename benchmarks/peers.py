# SPDX-License-Identifier: Apache-2.0
"""Odometry peers that need depth: Open3D's RGB-D odometry and KISS-ICP."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.system import Estimate
from slamdepth.errors import TrackingError
from slamdepth.frontend.clouds import depth_to_cloud
from slamdepth.geometry import orthonormalised
from slamdepth.open3d_loader import import_open3d
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Floats

MAX_DEPTH_M = 5.0
_ITERATIONS = (20, 10, 5)  # from the coarsest level
_MIN_FITNESS = 0.05  # share of pixels that must agree for a step to count


class _Odometry:
    """Collects poses frame by frame; the world is the first tracked camera."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._poses: list[Floats] = []

    def _add(self, frame: Frame, T_world_camera: Floats) -> None:
        self._times.append(frame.timestamp_s)
        self._poses.append(orthonormalised(T_world_camera))

    def finish(self) -> Estimate:
        """The collected poses; odometry has no final optimisation.

        Raises:
            TrackingError: no frame was tracked.
        """
        if not self._poses:
            raise TrackingError("it tracked no frame")
        return Estimate(Trajectory(np.array(self._times), np.stack(self._poses)))


class Open3dOdometry(_Odometry):
    """Frame-to-frame RGB-D odometry, multi-scale and hybrid (Park et al., ICCV 2017).

    Open3D has no lens distortion, so both images are undistorted within the measured time. The initial guess
    is a constant velocity, and the iterations are twice the default: otherwise it loses fast rotation. A
    frame that fails gets no pose, and the next frame is registered to the last tracked one.
    """

    def __init__(self, camera: Camera) -> None:
        import cv2

        super().__init__()
        self._o3d = import_open3d()
        self._K = self._o3d.core.Tensor(np.ascontiguousarray(camera.K))
        self._maps: tuple[Any, Any] | None = None
        if camera.is_distorted:
            self._maps = cv2.initUndistortRectifyMap(
                camera.K, camera.distortion_array, None, camera.K,
                (camera.width, camera.height), cv2.CV_32FC1,
            )  # fmt: skip
        criterion = self._o3d.t.pipelines.odometry.OdometryConvergenceCriteria
        self._criteria = [criterion(count) for count in _ITERATIONS]
        self._last: Any = None
        self._velocity: Floats = np.eye(4)  # T_last_now

    def step(self, frame: Frame) -> None:
        if frame.depth_m is None:
            return
        image = self._rgbd(frame)
        if self._last is None:
            self._last = image
            self._add(frame, np.eye(4))
            return
        T_last_now = self._register(image)
        self._velocity = np.eye(4) if T_last_now is None else T_last_now
        if T_last_now is None:
            return
        self._last = image
        self._add(frame, self._poses[-1] @ T_last_now)

    def _register(self, image: Any) -> Floats | None:
        try:
            result = self._o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                image,
                self._last,
                self._K,
                self._o3d.core.Tensor(self._velocity),
                depth_scale=1.0,
                depth_max=MAX_DEPTH_M,
                criteria_list=self._criteria,
            )
        except RuntimeError:  # the system of equations has no solution
            return None
        T_last_now = np.asarray(result.transformation.numpy(), dtype=np.float64)
        if result.fitness < _MIN_FITNESS or not np.isfinite(T_last_now).all():
            return None
        return T_last_now

    def _rgbd(self, frame: Frame) -> Any:
        import cv2

        assert frame.depth_m is not None
        colour, depth = frame.image_rgb, frame.depth_m
        if self._maps is not None:
            colour = np.asarray(cv2.remap(colour, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
            depth = np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), dtype=np.float32)
        image = self._o3d.t.geometry.Image
        return self._o3d.t.geometry.RGBDImage(
            image(np.ascontiguousarray(colour)), image(np.ascontiguousarray(depth))
        )


class KissIcp(_Odometry):
    """KISS-ICP (Vizzo et al., RA-L 2023) as published, with ranges for indoor scenes.

    Its clouds have every fourth pixel of a depth image, without depth edges.
    """

    def __init__(self, camera: Camera) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.config.config import DataConfig, MappingConfig
        from kiss_icp.kiss_icp import KissICP

        super().__init__()
        self._camera = camera
        config = KISSConfig(
            data=DataConfig(max_range=MAX_DEPTH_M, min_range=0.2, deskew=False),
            mapping=MappingConfig(voxel_size=0.05),
        )
        config.adaptive_threshold.initial_threshold = 0.1
        config.adaptive_threshold.min_motion_th = 0.01
        self._icp = KissICP(config)

    def step(self, frame: Frame) -> None:
        if frame.depth_m is None:
            return
        cloud = depth_to_cloud(frame.depth_m, self._camera, min_m=0.2, max_m=MAX_DEPTH_M)
        if len(cloud) == 0:
            return
        self._icp.register_frame(cloud, np.zeros(len(cloud)))
        self._icp.last_pose = orthonormalised(self._icp.last_pose)  # Sophus aborts on rounding
        self._icp.last_delta = orthonormalised(self._icp.last_delta)
        self._add(frame, self._icp.last_pose)
