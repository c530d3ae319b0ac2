# SPDX-License-Identifier: Apache-2.0
"""Point-to-plane ICP, which refines a registration, and how well geometry constrains it.

Chen and Medioni, "Object modelling by registration of multiple range images", 1992.
Point-to-point ICP between subsampled clouds pulls a slowly moving camera back
(each point of a wall finds a neighbour on the wall nearby); distances to planes do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import orthonormalised, so3_exp, transform
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True)
class PolishConfig:
    """Settings of point-to-plane ICP.

    Attributes:
        rounds: Gauss-Newton steps, each with new correspondences.
        points: approximate number of points of the cloud that are used.
        neighbours: map points that define a tangent plane.
        min_points: with fewer correspondences the pose is left as it is.
        min_observability: the pose is not moved along directions with less, see :func:`fit_quality`.
    """

    rounds: int = 3
    points: int = 600
    neighbours: int = 12
    min_points: int = 50
    min_observability: float = 0.005


def polish(
    tree: cKDTree, cloud_c: Floats, T_world_camera: Floats, *, reach_m: float, config: PolishConfig
) -> tuple[Floats, float]:
    """Refine the pose of a nearly registered cloud by point-to-plane ICP.

    The pose is not moved along directions that the geometry does not constrain (Zhang, Kaess and Singh,
    "On degeneracy of optimization-based state estimation problems", 2016).

    Args:
        tree: over the map's points in the world frame, metres.
        cloud_c: ``(N, 3)`` points in the camera frame, metres.
        T_world_camera: ``(4, 4)``, correct to within ``reach_m``.

    Returns:
        The pose and the length of the last step in metres; the pose as it was and infinity
        where too few points have the map within reach.
    """
    pose, step_m = T_world_camera, float("inf")
    for _ in range(config.rounds):
        points, _ = _matched(tree, transform(pose, cloud_c), reach_m, config)
        if len(points) < config.min_points:
            return T_world_camera, float("inf")
        surface = _surface(tree, points, config)
        weight = surface.flatness / (1.0 + (surface.distance_m / (0.2 * reach_m)) ** 2)
        rows, centre, radius_m = _rows(points, surface.normal)
        weighted = rows * weight[:, None] / len(rows)
        values, vectors = np.linalg.eigh(weighted.T @ rows)
        observable = 3.0 * values >= config.min_observability
        gradient = vectors[:, observable].T @ (weighted.T @ surface.distance_m)
        step = -vectors[:, observable] @ (gradient / values[observable])
        moved = np.eye(4)
        moved[:3, :3] = so3_exp(step[:3] / radius_m)
        moved[:3, 3] = centre + step[3:] - moved[:3, :3] @ centre
        pose = orthonormalised(moved @ pose)
        step_m = float(np.linalg.norm(step))
    return pose, step_m


def fit_quality(
    tree: cKDTree, cloud_w: Floats, inlier_m: float, config: PolishConfig
) -> tuple[float, float, float]:
    """Fitness, rmse in metres and observability of a registered cloud ``(N, 3)`` of the world frame.

    Fitness is the share of points with a map point within ``inlier_m``, rmse their distance
    to the map's tangent planes. Observability is three times the smallest eigenvalue of the
    mean normal matrix of point-to-plane ICP, rotations taken about the centre and lengths in
    radii of the cloud (after Gelfand et al., "Geometrically stable sampling for the ICP
    algorithm", 2003); the matrix of point-to-point ICP does not show that a plane slides
    along itself.
    """
    points, fitness = _matched(tree, cloud_w, inlier_m, config)
    if len(points) < 6:
        return fitness, float("inf"), 0.0
    surface = _surface(tree, points, config)
    rows, _, _ = _rows(points, surface.normal)
    normal_matrix = (rows * surface.flatness[:, None]).T @ rows / len(rows)
    observability = max(0.0, 3.0 * float(np.linalg.eigvalsh(normal_matrix)[0]))
    return fitness, float(np.sqrt(np.mean(surface.distance_m**2))), observability


@dataclass(frozen=True)
class _Surface:
    """Tangent planes of the map near some points.

    Attributes:
        normal: ``(N, 3)`` unit normals.
        distance_m: ``(N,)`` signed distances of the points from their planes.
        flatness: ``(N,)`` 1 for a perfect plane, 0 for noise, whose normal is arbitrary.
    """

    normal: Floats
    distance_m: Floats
    flatness: Floats


def _surface(tree: cKDTree, points_w: Floats, config: PolishConfig) -> _Surface:
    _, neighbours = tree.query(points_w, k=min(config.neighbours, tree.n))
    patches = np.asarray(tree.data)[neighbours]
    middle = patches.mean(axis=1)
    spread = patches - middle[:, None]
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    flatness = 1.0 - np.sqrt(np.maximum(variance[:, 0], 0.0) / np.maximum(variance[:, 1], 1e-12))
    normal = axes[:, :, 0]
    return _Surface(normal, np.einsum("ni,ni->n", points_w - middle, normal), flatness)


def _matched(tree: cKDTree, points_w: Floats, reach_m: float, config: PolishConfig) -> tuple[Floats, float]:
    """Some of the points that have the map within reach, and the share of all that do."""
    distance_m, _ = tree.query(points_w, distance_upper_bound=reach_m)
    matched = np.flatnonzero(np.isfinite(distance_m))
    share = len(matched) / max(len(points_w), 1)
    return points_w[matched[:: 1 + len(matched) // config.points]], share


def _rows(points_w: Floats, normals: Floats) -> tuple[Floats, Floats, float]:
    """Jacobian ``(N, 6)`` of the distances to planes; rotation about the centre, lengths in radii."""
    centre = points_w.mean(axis=0)
    arms = points_w - centre
    radius_m = max(float(np.sqrt(np.mean(np.sum(arms * arms, axis=1)))), 1e-9)
    return np.concatenate([np.cross(arms / radius_m, normals), normals], axis=1), centre, radius_m
