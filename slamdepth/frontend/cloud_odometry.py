# SPDX-License-Identifier: Apache-2.0
"""Odometry from depth alone: KISS-ICP, set for a depth camera in a room.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP - Simple, Accurate, and Robust
Registration If Done the Right Way", RA-L 2023, through the package ``kiss-icp``, whose
own defaults are a lidar's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.frontend.clouds import checked_cloud
from slamdepth.geometry import orthonormalised

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@dataclass(frozen=True)
class CloudOdometryConfig:
    """KISS-ICP for a depth camera in a room.

    Attributes:
        min_m, max_m: nearer and farther points, by range from the camera, are dropped.
        voxel_size_m: edge of a voxel of the local map; clouds are thinned to half of it
            for the map and to one and a half for the registration.
        points_per_voxel: points kept in a voxel of the local map.
        initial_threshold_m: expected error of the constant-velocity prediction at first;
            it adapts to what was seen, and correspondences are searched up to three times it.
        min_motion_m: smaller errors of the prediction do not adapt the threshold.
        min_points: a cloud with fewer points is not registered.
        iterations: upper bound of ICP iterations a cloud.
        convergence: ICP ends with a step shorter than this, in metres and radians.
    """

    min_m: float = 0.2
    max_m: float = 3.5
    voxel_size_m: float = 0.05
    points_per_voxel: int = 8
    initial_threshold_m: float = 0.1
    min_motion_m: float = 0.01
    min_points: int = 200
    iterations: int = 100
    convergence: float = 5e-4


class CloudOdometry:
    """The pose of each cloud of a sequence from its geometry alone; the world is the first camera.

    Deterministic: it registers on one thread, since sums over several vary with their order.
    """

    def __init__(self, config: CloudOdometryConfig | None = None) -> None:
        self.config = config or CloudOdometryConfig()
        self._icp = _kiss_icp(self.config)
        self._last_timestamp_s = -np.inf

    def register(self, cloud_c: Array, timestamp_s: float) -> Array | None:
        """Place the next cloud.

        Args:
            cloud_c: ``(N, 3)`` points in the camera frame, metres.
            timestamp_s: seconds, increasing from call to call.

        Returns:
            ``T_world_camera (4, 4)``, or None where fewer than ``min_points`` points lie
            within the range, which leaves the odometry as it was.

        Raises:
            TrackingError: the cloud has another shape or is not finite, or time does not increase.
        """
        cloud_c = checked_cloud(cloud_c, "cloud")
        if not timestamp_s > self._last_timestamp_s:
            raise TrackingError(
                f"cloud odometry: time must increase, got {timestamp_s} s after {self._last_timestamp_s} s"
            )
        self._last_timestamp_s = timestamp_s
        range_m = np.linalg.norm(cloud_c, axis=1)
        within = (range_m > self.config.min_m) & (range_m < self.config.max_m)
        if np.count_nonzero(within) < self.config.min_points:
            return None
        self._icp.register_frame(cloud_c[within], np.empty(0))
        pose = orthonormalised(np.array(self._icp.last_pose))
        self._icp.last_pose = pose
        self._icp.last_delta = orthonormalised(self._icp.last_delta)
        return pose.copy()

    @property
    def local_map_w(self) -> Array:
        """Points ``(M, 3)`` of the local map in the world frame."""
        return np.array(self._icp.local_map.point_cloud()).reshape(-1, 3)


def _kiss_icp(config: CloudOdometryConfig) -> Any:
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(
        KISSConfig(
            data=DataConfig(max_range=config.max_m, min_range=config.min_m, deskew=False),
            mapping=MappingConfig(
                voxel_size=config.voxel_size_m, max_points_per_voxel=config.points_per_voxel
            ),
            registration=RegistrationConfig(
                max_num_iterations=config.iterations,
                convergence_criterion=config.convergence,
                max_num_threads=1,
            ),
            adaptive_threshold=AdaptiveThresholdConfig(
                initial_threshold=config.initial_threshold_m, min_motion_th=config.min_motion_m
            ),
        )
    )
