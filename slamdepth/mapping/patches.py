# SPDX-License-Identifier: Apache-2.0
"""The small planes that the pixels of dense depth stand for, and how much each counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.mapping.dense_depth import DenseDepth
from slamdepth.mapping.fusion_depth import JUMP, at_jumps
from slamdepth.types import Camera
from slamdepth.typing import Bools, Bytes, Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_SIGMA = 0.1
"""Deviation of log depth from which a pixel is not fused: two layers at 2 m would be 20 cm apart."""

_LEAST_SIGMA_VOXELS = 1.0
_COMPLETED = 0.01
"""Weight of a completed pixel, as part of a measured one of the same deviation."""

_WINDOW_PX = 15


@dataclass(frozen=True)
class Patches:
    """What one view says of the space it sees: a small plane at each pixel.

    Attributes:
        camera: pinhole.
        T_world_camera: ``(4, 4)``.
        depth_m: ``(h, w)`` float32, 0 where there is nothing to fuse.
        normal: ``(h, w, 3)`` float32 unit normals in the camera's frame, away from the camera.
        weight: ``(h, w)`` float32; 1 for a measured pixel that is exact.
        image_rgb: ``(h, w, 3)`` uint8.
        color_weight: ``(h, w)`` float32.
    """

    camera: Camera
    T_world_camera: Floats
    depth_m: Floats32
    normal: Floats32
    weight: Floats32
    image_rgb: Bytes
    color_weight: Floats32

    @classmethod
    def of(cls, dense: DenseDepth, T_world_camera: Floats, voxel_m: float, max_depth_m: float) -> Patches:
        """The planes of dense depth.

        A pixel's weight is the inverse square of its deviation in voxels. Left out are depths beyond
        ``max_depth_m``, pixels at depth jumps, and those with a deviation of a tenth or more.

        The weight of a colour grows with the sharpness of the image, the cosine of incidence and closeness.
        """
        depth = np.where(np.isfinite(dense.depth_m), dense.depth_m, np.float32(0.0))
        normal, cosine = planes(depth, dense.camera)
        drop = (depth <= 0) | (depth > max_depth_m) | at_jumps(depth)
        depth = np.where(drop | ~(dense.sigma_log < _MOST_SIGMA), np.float32(0.0), depth)
        sigma = dense.sigma_log * depth / np.float32(voxel_m)
        weight = 1.0 / (sigma**2 + np.float32(_LEAST_SIGMA_VOXELS**2))
        color = (cosine / np.maximum(depth, np.float32(0.1))) ** 2 * _sharpness(dense.image_rgb)
        return cls(
            dense.camera,
            T_world_camera,
            depth,
            normal,
            np.where(dense.is_measured, weight, _COMPLETED * weight).astype(np.float32),
            dense.image_rgb,
            color.astype(np.float32),
        )


def planes(depth_m: Floats32, camera: Camera) -> tuple[Floats32, Floats32]:
    """Unit normals ``(h, w, 3)``, away from the camera, and the cosine ``(h, w)`` of incidence.

    The inverse depth of a plane is linear in the pixels, so a plane follows from the slopes of the inverse
    depth. They are taken over four pixels, or on one side where the other has a jump.
    """
    known = depth_m > 0
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), 0.0).astype(np.float32)
    across, down = _slopes(inverse), _slopes(inverse.T).T
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    u, v = u - np.float32(camera.cx), v - np.float32(camera.cy)
    fx, fy = np.float32(camera.fx), np.float32(camera.fy)
    normal = np.stack([across * fx, down * fy, inverse - across * u - down * v], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.float32(1e-12))
    ray = np.stack([u / fx, v / fy, np.ones_like(u)], axis=-1)
    cosine = np.einsum("ijk,ijk->ij", normal, ray) / np.linalg.norm(ray, axis=-1)
    return np.asarray(normal, np.float32), np.clip(cosine, 0.0, 1.0).astype(np.float32)


def _slopes(inverse: Floats32) -> Floats32:
    """Change of inverse depth ``(h, w)`` from column to column; 0 where no neighbour is known."""
    step = 2
    forth = np.full_like(inverse, np.nan)
    back = forth.copy()
    difference = (inverse[:, step:] - inverse[:, :-step]) / np.float32(step)
    difference[_unknown(inverse[:, step:]) | _unknown(inverse[:, :-step])] = np.nan
    forth[:, :-step] = difference
    back[:, step:] = difference
    smaller = np.where(np.abs(forth) <= np.abs(back), forth, back)
    jump = np.abs(forth - back) > JUMP * inverse
    mean = (forth + back) / np.float32(2.0)
    one = np.where(np.isnan(forth), back, forth)
    slope = np.where(np.isnan(mean), one, np.where(jump, smaller, mean))
    return np.asarray(np.nan_to_num(slope), np.float32)


def _unknown(inverse: Floats32) -> Bools:
    return np.asarray(inverse <= 0)


def _sharpness(image_rgb: NDArray[np.uint8]) -> Floats32:
    """Mean contrast of neighbouring pixels about each pixel ``(h, w)``, in grey values, plus 1."""
    import cv2

    grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    contrast = cv2.boxFilter(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), -1, (_WINDOW_PX, _WINDOW_PX))
    return np.asarray(contrast + 1.0, np.float32)
