# SPDX-License-Identifier: Apache-2.0
"""Images of a calibration board at exact poses through exact lenses."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from slamdepth.boards.board import Board
from slamdepth.geometry import so3_exp
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats

_FINE = 3
_BLACK, _WHITE, _BEHIND = 35.0, 215.0, 120.0


def rays_of(camera: Camera, px: Floats) -> Floats:
    """Unit rays ``(N, 3)`` of raw pixels ``(N, 2)``."""
    plane = (px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.lens is not None:
        return camera.lens.unproject(plane)
    flat = cv2.undistortPoints(
        plane[:, None], np.eye(3), camera.distortion_array, criteria=(3, 200, 1e-12)
    ).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def board_poses(board: Board, camera: Camera, count: int, seed: int, tilt_deg: float = 35.0) -> list[Floats]:
    """``T_camera_board`` in millimetres: the board turned and tilted, all over the image.

    A checkerboard is whole in each image; a ChArUco board need not be.
    """
    rng = np.random.default_rng(seed)
    middle = board.square_mm * np.array([*board.squares, 0.0]) / 2.0
    across = float(np.linalg.norm(2.0 * middle))
    focal = camera.fx * (camera.lens.slope if camera.lens else 1.0)
    poses = []
    reach, sizes = (1.0, (0.45, 0.8)) if board.kind == "charuco" else (0.62, (0.3, 0.5))
    for index in range(count):
        # A grid over the image, so that few views cover it.
        share = np.array([(index % 4 + 0.5) / 4, (index // 4 % 3 + 0.5) / 3]) + rng.uniform(-0.08, 0.08, 2)
        share = 0.5 + reach * (share - 0.5)
        ray = rays_of(camera, (share * [camera.width, camera.height])[None])[0]
        axis = np.cross([0.0, 0.0, 1.0], ray)
        length = float(np.linalg.norm(axis))
        facing = so3_exp(axis / max(length, 1e-12) * np.arctan2(length, ray[2]))
        tilts = np.radians(rng.uniform(0.4, 1.0, 2) * rng.choice([-1, 1], 2) * tilt_deg)
        turned = so3_exp(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)])) @ so3_exp(np.array([*tilts, 0.0]))
        T = np.eye(4)
        T[:3, :3] = facing @ turned
        distance = focal * across / (rng.uniform(*sizes) * camera.width)
        T[:3, 3] = distance * ray - T[:3, :3] @ middle
        poses.append(T)
    return poses


@lru_cache(maxsize=2)
def _fine_rays(camera: Camera) -> Floats:
    offsets = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    u = (np.arange(camera.width)[:, None] + offsets).ravel()
    v = (np.arange(camera.height)[:, None] + offsets).ravel()
    return rays_of(camera, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))


def board_image(board: Board, camera: Camera, T_camera_board: Floats, noise: float, seed: int) -> Bytes:
    """What the camera sees of the board, ``(H, W)``, each pixel the mean of nine rays."""
    black, cell_mm = board.is_black()
    rays = _fine_rays(camera)
    normal, origin = T_camera_board[:3, 2], T_camera_board[:3, 3]
    with np.errstate(all="ignore"):
        distance = (normal @ origin) / (rays @ normal)
        on_board = (rays * distance[:, None] - origin) @ T_camera_board[:3, :2]
        x, y = np.floor(on_board / cell_mm).T
        is_seen = distance > 0
    margin = 0.6 * board.square_mm / cell_mm
    height, width = black.shape
    on_paper = is_seen & (x >= -margin) & (x < width + margin) & (y >= -margin) & (y < height + margin)
    on_cells = is_seen & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    grey = np.where(on_paper, _WHITE, _BEHIND)
    cells = black[y[on_cells].astype(int), x[on_cells].astype(int)]
    grey[on_cells] = np.where(cells, _BLACK, _WHITE)
    fine = grey.reshape(camera.height, _FINE, camera.width, _FINE).mean(axis=(1, 3))
    noisy = fine + np.random.default_rng(seed).normal(0.0, noise, fine.shape)
    return np.asarray(np.clip(np.round(noisy), 0, 255), np.uint8)
