# SPDX-License-Identifier: Apache-2.0
"""The size of a square marker in the map, from the images that show it.

The poses of the images are those of the map. Unknown are the marker's pose and its side in metres of the map,
eight reprojected coordinates an image tell them. One image tells the ratio of side and distance only, so it
takes parallax.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.geometry import so3_exp
from slamdepth.robust import robust_deviation
from slamdepth.types import Camera
from slamdepth.typing import Floats, Ints

_SIGMA_PX = 0.3  # of a refined corner, at least
_ROBUST_PX = 2.0
_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners of a marker of side 1, in the order of OpenCV; its normal is z."""


@dataclass(frozen=True)
class Sighting:
    """A marker in one image.

    Attributes:
        T_world_camera: ``(4, 4)`` pose of the image in the map.
        corners_px: ``(4, 2)`` without distortion.
        group: images of one group share the error of their pose (those of one keyframe).
    """

    T_world_camera: Floats
    corners_px: Floats
    group: int


@dataclass(frozen=True)
class MarkerFit:
    """A marker in the map.

    Attributes:
        side: of its square, in metres of the map.
        sigma_log: standard error of the log of ``side``.
        centre: ``(3,)`` world.
        parallax_deg: largest angle at the marker between two cameras.
        residual_px: robust standard deviation of the corners about the fit.
    """

    side: float
    sigma_log: float
    centre: Floats
    parallax_deg: float
    residual_px: float


def fit_marker(camera: Camera, sightings: Sequence[Sighting]) -> MarkerFit | None:
    """Fit pose and side of a marker to all sightings.

    The covariance is that of residuals clustered by group (sandwich estimator, Liang and Zeger 1986), but not
    less than corners of ``_SIGMA_PX`` allow, two of the four of a group being independent of the pose.

    Args:
        camera: without distortion.
        sightings: of one marker.

    Returns:
        None where no marker of any size explains what is seen.
    """
    from scipy.optimize import least_squares

    T_camera_world = np.linalg.inv(np.array([s.T_world_camera for s in sightings]))
    corners = np.array([s.corners_px for s in sightings])
    centre = _triangulated([s.T_world_camera for s in sightings], camera, corners.mean(axis=1))
    best = None
    for R, side in _starts(camera, sightings, centre):

        def residuals(x: Floats, R: Floats = R, side: float = side) -> Floats:
            square = (
                side * math.exp(x[6]) * _SQUARE @ (R @ so3_exp(x[None, :3])[0]).T + centre + x[3:6] * side
            )
            points = (
                np.einsum("nij,kj->nki", T_camera_world[:, :3, :3], square) + T_camera_world[:, None, :3, 3]
            )
            z = np.maximum(points[..., 2:], 1e-9)
            pixels = points[..., :2] / z * [camera.fx, camera.fy] + [camera.cx, camera.cy]
            return np.asarray(pixels - corners).ravel()

        found = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=_ROBUST_PX, max_nfev=100)
        if best is None or found.cost < best[0].cost:
            best = found, side, residuals
    if best is None:
        return None
    found, side, residuals = best
    off = residuals(found.x)
    groups = np.repeat([s.group for s in sightings], 8)
    return MarkerFit(
        side=side * math.exp(found.x[6]),
        sigma_log=_sigma(found.jac, off, groups),
        centre=centre + found.x[3:6] * side,
        parallax_deg=_parallax_deg(centre + found.x[3:6] * side, sightings),
        residual_px=robust_deviation(off, 0.0),
    )


def _starts(camera: Camera, sightings: Sequence[Sighting], centre: Floats) -> list[tuple[Floats, float]]:
    """Rotations in the world and sides to start from: both solutions for the largest image of the square."""
    import cv2

    areas = [float(cv2.contourArea(s.corners_px.astype(np.float32))) for s in sightings]
    largest = sightings[int(np.argmax(areas))]
    _, rotations, shifts, _ = cv2.solvePnPGeneric(
        _SQUARE, largest.corners_px, camera.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    T = largest.T_world_camera
    distance = float(np.linalg.norm(centre - T[:3, 3]))
    return [
        (T[:3, :3] @ cv2.Rodrigues(rotation)[0], distance / max(float(np.linalg.norm(shift)), 1e-9))
        for rotation, shift in zip(rotations, shifts, strict=True)
    ]


def _triangulated(poses: Sequence[Floats], camera: Camera, pixels: Floats) -> Floats:
    """The point ``(3,)`` nearest to the rays through ``pixels (N, 2)``."""
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
    A, b = np.zeros((3, 3)), np.zeros(3)
    for T, ray in zip(poses, rays, strict=True):
        along = T[:3, :3] @ ray / np.linalg.norm(ray)
        across = np.eye(3) - np.outer(along, along)
        A += across
        b += across @ T[:3, 3]
    # without parallax the distance is open: a little pull to the unit distance keeps it finite
    ahead = poses[0][:3, 3] + poses[0][:3, :3] @ rays[0]
    return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b + 1e-9 * ahead))


def _sigma(J: Floats, off: Floats, groups: Ints) -> float:
    """Standard error of the last parameter."""
    weight = 1.0 / np.sqrt(1.0 + (off / _ROBUST_PX) ** 2)
    information = J.T @ J
    covariance = np.linalg.pinv(information, rcond=1e-14)
    scores = np.array(
        [(J[groups == g] * (off * weight)[groups == g, None]).sum(axis=0) for g in np.unique(groups)]
    )
    count = len(scores)
    clustered = covariance @ (scores.T @ scores) @ covariance * (count / max(1, count - 1))
    rows = len(off) / count / 4.0  # of each group, four rows count as independent
    by_pixels = covariance * max(_SIGMA_PX, robust_deviation(off, 0.0)) ** 2 * rows
    return math.sqrt(max(float(clustered[6, 6]), float(by_pixels[6, 6]), 1e-12))


def _parallax_deg(centre: Floats, sightings: Sequence[Sighting]) -> float:
    rays = np.array([centre - s.T_world_camera[:3, 3] for s in sightings])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    return math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
