# SPDX-License-Identifier: Apache-2.0
"""First intrinsics, and poses of a board, without any guess: the field of view that fits best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.boards.board import Board, Sighting
from slamdepth.boards.lens import FISHEYE, LensModel
from slamdepth.geometry import orthonormalised
from slamdepth.typing import Floats

_VIEWS_DEG = {False: np.arange(15.0, 131.0, 5.0), True: np.arange(40.0, 231.0, 10.0)}
"""Fields of view across the longer side that are tried, for pinhole and fisheye."""


def first_guess(
    model: LensModel, board: Board, sightings: Sequence[Sighting], size: tuple[int, int]
) -> tuple[Floats, list[Floats]]:
    """Intrinsics ``(4 + k,)`` without distortion, and ``T_camera_board`` of each sighting in millimetres.

    Args:
        size: width and height of the images.
    """
    centre = [(size[0] - 1) / 2.0, (size[1] - 1) / 2.0]
    best: tuple[float, Floats, list[Floats]] | None = None
    for view_deg in _VIEWS_DEG[model is FISHEYE]:
        focal = max(size) / 2.0 / model.radius(np.radians(view_deg) / 2.0)
        values = np.array([focal, focal, *centre, *np.zeros(len(model.coefficients))])
        poses = [pose_of(model, values, board, sighting) for sighting in sightings]
        errors = [
            np.sqrt(np.mean(np.sum(residuals(model, values, board, sighting, T) ** 2, axis=1)))
            for sighting, T in zip(sightings, poses, strict=True)
        ]
        error = float(np.median(errors))
        if best is None or error < best[0]:
            best = error, values, poses
    assert best is not None
    return best[1], best[2]


def residuals(
    model: LensModel, values: Floats, board: Board, sighting: Sighting, T_camera_board: Floats
) -> Floats:
    """Projections less measured pixels ``(N, 2)``."""
    points = board.corners_mm[sighting.ids]
    return model.project(values, points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]) - sighting.px


def pose_of(model: LensModel, values: Floats, board: Board, sighting: Sighting) -> Floats:
    """``T_camera_board`` ``(4, 4)`` from the homography between the board and the rays of its corners.

    Distortion is left out; rays may point backwards.
    """
    plane = (sighting.px - values[2:4]) / values[:2]
    rho = np.hypot(plane[:, 0], plane[:, 1])
    theta = rho if model is FISHEYE else np.arctan(rho)
    share = np.sin(theta) / np.maximum(rho, 1e-12)
    rays = np.column_stack([plane * share[:, None], np.cos(theta)])
    xy = board.corners_mm[sighting.ids, :2]
    middle, spread = xy.mean(axis=0), float(np.std(xy))
    flat = np.column_stack([(xy - middle) / spread, np.ones(len(xy))])
    x, y, z = (rays[:, i : i + 1] for i in range(3))
    nothing = np.zeros_like(flat)
    rows = np.concatenate(
        [
            np.hstack([nothing, -z * flat, y * flat]),
            np.hstack([z * flat, nothing, -x * flat]),
            np.hstack([-y * flat, x * flat, nothing]),
        ]
    )
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    if np.sum(rays * (flat @ H.T)) < 0:
        H = -H
    scale = spread / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1])) * 2.0
    H = H * scale / spread
    T = np.eye(4)
    T[:3, :3] = np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])])
    T[:3, :3] = orthonormalised(T)[:3, :3]
    T[:3, 3] = H[:, 2] * spread - T[:3, :2] @ middle
    return T
