# SPDX-License-Identifier: Apache-2.0
"""Odometry from depth alone: KISS-ICP, set for a depth camera in a room.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP - Simple, Accurate, and Robust
Registration If Done the Right Way", RA-L 2023, through the package ``kiss-icp``, whose
own defaults are a lidar's. Each pose is refined by point-to-plane ICP before the cloud enters the
map: in the narrow view of a depth camera on walls, point-to-point ICP lags behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.frontend.clouds import checked_cloud
from slamdepth.frontend.point_to_plane import PolishConfig, polish
from slamdepth.geometry import invert, orthonormalised
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True)
class CloudOdometryConfig:
    """KISS-ICP for a depth camera in a room.

    Attributes:
        min_m, max_m: nearer and farther points, by range from the camera, are dropped.
        voxel_size_m: edge of a voxel of the local map; clouds are subsampled at half of it
            for the map and at one and a half for the registration.
        points_per_voxel: points kept in a voxel of the local map.
        initial_threshold_m: expected error of the constant-velocity prediction at first;
            it adapts to what was seen, and correspondences are searched up to three times it.
        min_motion_m: smaller errors of the prediction do not adapt the threshold.
        min_points: a cloud with fewer points is not registered.
        iterations: upper bound of ICP iterations per cloud.
        polish: point-to-plane steps after ICP; none with ``rounds=0``.
        tree_every: the search tree of the refinement is rebuilt after this many clouds.
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
    polish: PolishConfig = field(default_factory=lambda: PolishConfig(rounds=2))
    tree_every: int = 5


class CloudOdometry:
    """The pose of each cloud of a sequence from its geometry alone; the world is the first camera.

    Deterministic: it registers on one thread, since sums over several vary with their order.
    """

    def __init__(self, config: CloudOdometryConfig | None = None) -> None:
        self.config = config or CloudOdometryConfig()
        self._icp = _kiss_icp(self.config)
        self._last_timestamp_s = -np.inf
        self._clouds = 0
        self._tree: cKDTree | None = None

    def register(self, cloud_c: Floats, timestamp_s: float) -> Floats | None:
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
        pose: Floats = self._step(cloud_c[within]).copy()
        self._clouds += 1
        return pose

    def _step(self, cloud_c: Floats) -> Floats:
        """KISS-ICP's own step, with the refinement between its registration and its map."""
        icp = self._icp
        source_c, for_map_c = icp.voxelize(cloud_c)
        guess = orthonormalised(icp.last_pose @ icp.last_delta)
        sigma_m = icp.adaptive_threshold.get_threshold()
        pose = icp.registration.align_points_to_map(
            points=source_c,
            voxel_map=icp.local_map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma_m,
            kernel=sigma_m,
        )
        # Sophus, inside KISS-ICP, aborts the process on a rotation that is not exactly one.
        pose = self._polished(source_c, orthonormalised(np.array(pose)))
        icp.adaptive_threshold.update_model_deviation(orthonormalised(invert(guess) @ pose))
        icp.local_map.update(for_map_c, pose)
        icp.last_delta = orthonormalised(invert(icp.last_pose) @ pose)
        icp.last_pose = pose
        return pose

    def _polished(self, source_c: Floats, pose: Floats) -> Floats:
        from scipy.spatial import cKDTree

        if self._clouds == 0 or self.config.polish.rounds == 0:
            return pose
        if self._tree is None or self._clouds % self.config.tree_every == 0:
            self._tree = cKDTree(self.local_map_w)
        pose, _ = polish(
            self._tree, source_c, pose, reach_m=self.config.voxel_size_m, config=self.config.polish
        )
        return pose

    @property
    def local_map_w(self) -> Floats:
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
