# SPDX-License-Identifier: Apache-2.0
"""How well images agree for depths about a predicted one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.geometry import invert
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats, Floats32

WINDOW_PX = 7
_NOISE = 3.0  # grey values: what differs by less is noise, compression included
_WORST = np.float32(1.2)  # cost of what does not correspond; 1 is no correlation
_NEAREST_M = np.float32(0.05)


@dataclass(frozen=True)
class View:
    """A rectified image.

    Attributes:
        grey: ``(h, w)`` uint8, 0 where it shows nothing.
        T_world_camera: ``(4, 4)``.
    """

    grey: Bytes
    T_world_camera: Floats


def matching_cost(
    keyframe: View, sheet_m: Floats32, views: Sequence[View], camera: Camera, log_ratios: Floats32
) -> Floats32:
    """Dissimilarity of a keyframe's pixels to other views, for depths about a sheet.

    The cost is one minus the zero-mean normalised cross-correlation of windows, which no change of exposure
    alters. The variance of noise is added to that of the windows, so what has no texture costs about 1 at
    every depth. The views are of two sides of the keyframe; what one side sees occluded, the other may see
    (Kang et al., "Handling occlusions in dense multi-view stereo", CVPR 2001): the cost is the mean of all
    views' and of the better side's.

    Args:
        sheet_m: ``(h, w)`` depth, above 0 everywhere.
        views: at least one.
        camera: pinhole, of all images.
        log_ratios: ``(L,)`` natural log of the ratios of depth to ``sheet_m`` that are tried.

    Returns:
        ``(L, h, w)`` float32, 0 to 1.2.
    """
    import cv2

    projections = [_Projection.of(keyframe, view, camera) for view in views]
    sides = _sides(keyframe, views)
    grey = keyframe.grey.astype(np.float32)
    mean, variance = _moments(grey)
    cost = np.empty((len(log_ratios), *sheet_m.shape), np.float32)
    kernel = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    for level, log_ratio in enumerate(log_ratios):
        depth_m = sheet_m * np.exp(log_ratio)
        total = np.zeros((2, *sheet_m.shape), np.float32)
        number = np.zeros((2, *sheet_m.shape), np.float32)
        for projection, view, side in zip(projections, views, sides, strict=True):
            x, y = projection.pixels(depth_m)
            warped = cv2.remap(view.grey, x, y, cv2.INTER_LINEAR, borderValue=0)
            valid = cv2.erode((warped > 0).view(np.uint8), kernel).astype(np.float32)
            other = warped.astype(np.float32)
            sums = _mean(np.asarray(cv2.merge([other, other * other, other * grey]), np.float32))
            covariance = sums[..., 2] - sums[..., 0] * mean
            scatter = np.maximum(sums[..., 1] - sums[..., 0] ** 2, 0.0) + np.float32(_NOISE**2)
            correlation = covariance / np.sqrt(scatter * variance)
            total[side] += valid * (1.0 - correlation)
            number[side] += valid
        cost[level] = _combined(total, number)
    return cost


@dataclass(frozen=True)
class _Projection:
    """From a pixel and its depth to the pixel of another view: ``(along * depth + offset)``, homogeneous."""

    along: tuple[Floats32, Floats32, Floats32]
    offset: Floats32

    @classmethod
    def of(cls, keyframe: View, view: View, camera: Camera) -> _Projection:
        T_view_keyframe = invert(view.T_world_camera) @ keyframe.T_world_camera
        M = camera.K @ T_view_keyframe[:3, :3] @ np.linalg.inv(camera.K)
        height, width = keyframe.grey.shape
        u, v = np.arange(width)[None], np.arange(height)[:, None]
        rows = tuple((row[0] * u + row[1] * v + row[2]).astype(np.float32) for row in M)
        return cls((rows[0], rows[1], rows[2]), (camera.K @ T_view_keyframe[:3, 3]).astype(np.float32))

    def pixels(self, depth_m: Floats32) -> tuple[Floats32, Floats32]:
        per_depth = 1.0 / np.maximum(self.along[2] * depth_m + self.offset[2], _NEAREST_M)
        x = (self.along[0] * depth_m + self.offset[0]) * per_depth
        y = (self.along[1] * depth_m + self.offset[1]) * per_depth
        return x, y


def _sides(keyframe: View, views: Sequence[View]) -> list[int]:
    """Which of two sides each view is of, along the direction in which they are spread most."""
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    places = np.array([(view.T_world_camera[:3, 3] - t) @ R for view in views])
    _, _, axes = np.linalg.svd(places - np.median(places, axis=0))
    along = places @ axes[0]
    return [int(value > np.median(along)) for value in along]


def _mean(values: Floats32) -> Floats32:
    import cv2

    size = (WINDOW_PX, WINDOW_PX)
    return np.asarray(cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _moments(grey: Floats32) -> tuple[Floats32, Floats32]:
    mean = _mean(grey)
    return mean, np.maximum(_mean(grey * grey) - mean * mean, 0.0) + np.float32(_NOISE**2)


def _combined(total: Floats32, number: Floats32) -> Floats32:
    each = np.where(number > 0, total / np.maximum(number, 1.0), 2.0 * _WORST)
    both = total.sum(axis=0) / np.maximum(number.sum(axis=0), 1.0)
    better = each.min(axis=0)
    cost = np.where((number > 0).all(axis=0), 0.5 * (both + better), better)
    cost[number.sum(axis=0) == 0] = 1.0
    return np.asarray(np.minimum(cost, _WORST), np.float32)
