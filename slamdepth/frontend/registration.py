# SPDX-License-Identifier: Apache-2.0
"""Registration of one cloud to a local map: the rescue where too few features match.

The search is KISS-ICP's (see :mod:`slamdepth.frontend.cloud_odometry`). A pose found this
way is only worth something with a verdict, so the result says how well it fits and
whether the geometry holds it in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.frontend.cloud_odometry import CloudOdometry, CloudOdometryConfig
from slamdepth.frontend.clouds import checked_cloud, depth_to_cloud
from slamdepth.geometry import invert, orthonormalised, rotation_angle_rad, so3_exp, transform

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy.spatial import cKDTree

    Array = NDArray[np.float64]

__all__ = [
    "CloudOdometry",
    "CloudOdometryConfig",
    "RegistrationConfig",
    "RegistrationResult",
    "depth_to_cloud",
    "register_cloud",
]

# Enough for normals and a verdict; more only cost time.
_MOST_POINTS = 1500
_NORMAL_NEIGHBOURS = 20
_POLISH_ROUNDS = 6


@dataclass(frozen=True)
class RegistrationConfig:
    """How a cloud is registered to a local map, and when the result is trusted.

    Attributes:
        voxel_size_m: edge of a voxel; map and cloud are thinned to half of it.
        search_m: correspondences are searched so far at first, then within two voxels.
        min_points: with fewer points on either side nothing is registered.
        min_fitness, max_rmse_m, min_observability: bounds of what is trusted.
        max_moved_m, max_turned_rad: farthest that a trusted result lies from the guess.
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
    """Where a cloud lies in a local map, and how far to trust it.

    Attributes:
        T_world_camera: ``(4, 4)``; the guess where there was too little to register.
        fitness: share of the cloud's points with a map point within a voxel's size.
        rmse_m: root mean square distance of those points from the map's surface.
        observability: from 0 to about 1, how well the geometry holds the direction of
            motion that it holds least; 0 for a plane, along which a cloud slides freely.
        converged: the last round of polishing hardly moved the cloud.
        is_trusted: the verdict on all of these and the distance from the guess.
    """

    T_world_camera: Array
    fitness: float
    rmse_m: float
    observability: float
    converged: bool
    is_trusted: bool


def register_cloud(
    local_map_w: Array,
    cloud_c: Array,
    T_world_camera_guess: Array,
    config: RegistrationConfig | None = None,
) -> RegistrationResult:
    """Register a cloud to the points of a local map.

    KISS-ICP's point-to-point registration from coarse to fine, which has a wide basin, then
    a few steps of point-to-plane ICP, which is exact where thinned points do not coincide.

    Args:
        local_map_w: ``(M, 3)`` points in the world frame, metres.
        cloud_c: ``(N, 3)`` points in the camera frame, metres.
        T_world_camera_guess: ``(4, 4)``, which should bring most points to within ``search_m``.

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
    pose, last_step = _polish(tree, cloud_c, pose, config)
    fitness, rmse_m, observability = _quality(tree, transform(pose, cloud_c), voxel_m)
    converged = last_step < 0.1 * voxel_m
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


def _align(map_w: Array, cloud_c: Array, guess: Array, *, voxel_m: float, reach_m: float) -> Array:
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


def _motion(T_world_a: Array, T_world_b: Array) -> tuple[float, float]:
    """Distance in metres and angle in radians between two poses."""
    T_a_b = invert(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3])), float(rotation_angle_rad(T_a_b[:3, :3]))


@dataclass(frozen=True)
class _Surface:
    """Tangent planes of the map beside some points.

    Attributes:
        middle: ``(N, 3)`` a point of each plane.
        normal: ``(N, 3)`` unit normals.
        flatness: ``(N,)`` 1 for a perfect plane, 0 for noise, whose normal says nothing.
    """

    middle: Array
    normal: Array
    flatness: Array


def _surface(tree: cKDTree, points_w: Array) -> _Surface:
    _, beside = tree.query(points_w, k=min(_NORMAL_NEIGHBOURS, tree.n))
    patches = np.asarray(tree.data)[beside]
    middle = patches.mean(axis=1)
    spread = patches - middle[:, None]
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    flatness = 1.0 - np.sqrt(np.maximum(variance[:, 0], 0.0) / np.maximum(variance[:, 1], 1e-12))
    return _Surface(middle, axes[:, :, 0], flatness)


def _matched(tree: cKDTree, points_w: Array, reach_m: float) -> tuple[NDArray[np.intp], float]:
    """Indices of some points that have the map within reach, and the share of all that do."""
    distance_m, _ = tree.query(points_w, distance_upper_bound=reach_m)
    matched = np.flatnonzero(np.isfinite(distance_m))
    return matched[:: 1 + len(matched) // _MOST_POINTS], len(matched) / len(points_w)


def _rows(points_w: Array, normals: Array) -> tuple[Array, Array, float]:
    """Jacobian ``(N, 6)`` of the distances to planes; rotation about the centre, lengths in radii."""
    centre = points_w.mean(axis=0)
    arms = points_w - centre
    radius_m = max(float(np.sqrt(np.mean(np.sum(arms * arms, axis=1)))), 1e-9)
    return np.concatenate([np.cross(arms / radius_m, normals), normals], axis=1), centre, radius_m


def _polish(
    tree: cKDTree, cloud_c: Array, T_world_camera: Array, config: RegistrationConfig
) -> tuple[Array, float]:
    """Point-to-plane Gauss-Newton; returns the pose and the length in metres of the last step.

    Directions that the geometry does not hold are left as they are (Zhang, Kaess and Singh,
    "On degeneracy of optimization-based state estimation problems", 2016).
    """
    pose, step_m = T_world_camera, float("inf")
    for _ in range(_POLISH_ROUNDS):
        points = transform(pose, cloud_c)
        matched, _ = _matched(tree, points, config.voxel_size_m)
        if len(matched) < config.min_points // 4:
            return T_world_camera, float("inf")
        points = points[matched]
        surface = _surface(tree, points)
        residual = np.einsum("ni,ni->n", points - surface.middle, surface.normal)
        weight = surface.flatness / (1.0 + (residual / (0.2 * config.voxel_size_m)) ** 2)
        rows, centre, radius_m = _rows(points, surface.normal)
        values, vectors = np.linalg.eigh((rows * weight[:, None]).T @ rows / len(rows))
        gradient = (rows * weight[:, None]).T @ residual / len(rows)
        held = 3.0 * values >= config.min_observability * 0.1
        step = -vectors[:, held] @ ((vectors[:, held].T @ gradient) / values[held])
        moved = np.eye(4)
        moved[:3, :3] = so3_exp(step[:3] / radius_m)
        moved[:3, 3] = centre + step[3:] - moved[:3, :3] @ centre
        pose = orthonormalised(moved @ pose)
        step_m = float(np.linalg.norm(step))
    return pose, step_m


def _quality(tree: cKDTree, cloud_w: Array, inlier_m: float) -> tuple[float, float, float]:
    """Fitness, rmse in metres and observability of a registered cloud.

    Observability is three times the smallest eigenvalue of the mean normal matrix of
    point-to-plane ICP, rotations taken about the centre and lengths in radii of the cloud
    (after Gelfand et al., "Geometrically stable sampling for the ICP algorithm", 2003);
    the matrix of point-to-point ICP does not see that a plane slides along itself.
    """
    matched, fitness = _matched(tree, cloud_w, inlier_m)
    if len(matched) < 6:
        return fitness, float("inf"), 0.0
    points = cloud_w[matched]
    surface = _surface(tree, points)
    residual = np.einsum("ni,ni->n", points - surface.middle, surface.normal)
    rows, _, _ = _rows(points, surface.normal)
    normal_matrix = (rows * surface.flatness[:, None]).T @ rows / len(rows)
    observability = max(0.0, 3.0 * float(np.linalg.eigvalsh(normal_matrix)[0]))
    return fitness, float(np.sqrt(np.mean(residual**2))), observability
