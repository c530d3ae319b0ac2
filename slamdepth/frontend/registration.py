# SPDX-License-Identifier: Apache-2.0
"""Registration of one cloud to a local map, the fallback where too few features match.

The search is KISS-ICP's (see :mod:`slamdepth.frontend.cloud_odometry`). The result says how well the
cloud fits, whether the geometry constrains the pose in every direction, and whether to trust it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.frontend.cloud_odometry import CloudOdometry, CloudOdometryConfig
from slamdepth.frontend.clouds import checked_cloud, depth_to_cloud
from slamdepth.frontend.point_to_plane import PolishConfig, fit_quality, polish
from slamdepth.geometry import invert, orthonormalised, rotation_angle_rad, transform
from slamdepth.typing import Floats

__all__ = [
    "CloudOdometry",
    "CloudOdometryConfig",
    "RegistrationConfig",
    "RegistrationResult",
    "depth_to_cloud",
    "register_cloud",
]

_POLISH = PolishConfig(rounds=6, points=1500, neighbours=20)


@dataclass(frozen=True)
class RegistrationConfig:
    """Settings of the registration, and bounds of a result that is trusted.

    Attributes:
        voxel_size_m: edge of a voxel; map and cloud are thinned to half of it.
        search_m: search radius of correspondences at first; then it is two voxels.
        min_points: with fewer points on either side nothing is registered.
        min_fitness, max_rmse_m, min_observability: bounds of what is trusted.
        max_moved_m, max_turned_rad: largest distance of a trusted result from the guess.
    """

    voxel_size_m: float = 0.05
    search_m: float = 0.2
    min_points: int = 200
    min_fitness: float = 0.7
    max_rmse_m: float = 0.02
    min_observability: float = 0.05
    max_moved_m: float = 0.4
    max_turned_rad: float = 0.4


@dataclass(frozen=True)
class RegistrationResult:
    """The pose of a cloud in a local map, and how reliable it is.

    Attributes:
        T_world_camera: ``(4, 4)``; the guess where there was too little to register.
        fitness: share of the cloud's points with a map point within a voxel's size.
        rmse_m: root mean square distance of those points from the map's surface.
        observability: from 0 to about 1, how well the geometry constrains the least constrained
            direction of motion; 0 for a plane, along which a cloud slides freely.
        converged: the last step of the refinement hardly moved the cloud.
        is_trusted: all of these and the distance from the guess are within bounds.
    """

    T_world_camera: Floats
    fitness: float
    rmse_m: float
    observability: float
    converged: bool
    is_trusted: bool


def register_cloud(
    local_map_w: Floats,
    cloud_c: Floats,
    T_world_camera_guess: Floats,
    config: RegistrationConfig | None = None,
) -> RegistrationResult:
    """Register a cloud to the points of a local map.

    KISS-ICP's point-to-point registration from coarse to fine, which has a wide basin of convergence,
    then a few steps of point-to-plane ICP, which does not need subsampled points to coincide.

    Args:
        local_map_w: ``(M, 3)`` points in the world frame, metres.
        cloud_c: ``(N, 3)`` points in the camera frame, metres.
        T_world_camera_guess: ``(4, 4)``, which should bring most points to within ``search_m`` of the map.

    Raises:
        TrackingError: a cloud or the guess has another shape or is not finite.
    """
    config = config or RegistrationConfig()
    map_w, cloud_c = checked_cloud(local_map_w, "local map"), checked_cloud(cloud_c, "cloud")
    guess = np.asarray(T_world_camera_guess, dtype=np.float64)
    if guess.shape != (4, 4) or not np.all(np.isfinite(guess)):
        raise TrackingError("registration: the guess must be a finite (4, 4) pose")
    # Sophus, inside KISS-ICP, aborts the process on a rotation that is not exactly one.
    guess = orthonormalised(guess)
    if min(len(map_w), len(cloud_c)) < config.min_points:
        return RegistrationResult(guess.copy(), 0.0, float("inf"), 0.0, False, False)

    from kiss_icp.voxelization import voxel_down_sample
    from scipy.spatial import cKDTree

    voxel_m = config.voxel_size_m
    map_w = np.array(voxel_down_sample(map_w, 0.5 * voxel_m))
    cloud_c = np.array(voxel_down_sample(cloud_c, 0.5 * voxel_m))
    sparse_c = np.array(voxel_down_sample(cloud_c, 1.5 * voxel_m))
    pose = _align(map_w, sparse_c, guess, voxel_m=config.search_m, reach_m=config.search_m)
    pose = _align(map_w, sparse_c, pose, voxel_m=voxel_m, reach_m=2.0 * voxel_m)
    tree = cKDTree(map_w)
    pose, last_step_m = polish(tree, cloud_c, pose, reach_m=voxel_m, config=_POLISH)
    fitness, rmse_m, observability = fit_quality(tree, transform(pose, cloud_c), voxel_m, _POLISH)
    converged = last_step_m < 0.1 * voxel_m
    moved_m, turned_rad = _motion(guess, pose)
    is_trusted = (
        converged
        and fitness >= config.min_fitness
        and rmse_m <= config.max_rmse_m
        and observability >= config.min_observability
        and moved_m <= config.max_moved_m
        and turned_rad <= config.max_turned_rad
    )
    return RegistrationResult(pose, fitness, rmse_m, observability, converged, is_trusted)


def _align(map_w: Floats, cloud_c: Floats, guess: Floats, *, voxel_m: float, reach_m: float) -> Floats:
    """One run of KISS-ICP's point-to-point ICP; it sees no farther than the neighbouring voxels."""
    from kiss_icp.mapping import VoxelHashMap
    from kiss_icp.registration import Registration

    # The caller chose the map, so none of its points is too far away.
    grid = VoxelHashMap(voxel_size=voxel_m, max_distance=1e6, max_points_per_voxel=20)
    grid.add_points(map_w)
    icp = Registration(max_num_iterations=100, convergence_criterion=2e-4, max_num_threads=1)
    pose = icp.align_points_to_map(
        points=cloud_c,
        voxel_map=grid,
        initial_guess=guess,
        max_correspondance_distance=reach_m,
        kernel=reach_m / 3.0,
    )
    return orthonormalised(np.array(pose))


def _motion(T_world_a: Floats, T_world_b: Floats) -> tuple[float, float]:
    """Distance in metres and angle in radians between two poses."""
    T_a_b = invert(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3])), float(rotation_angle_rad(T_a_b[:3, :3]))
