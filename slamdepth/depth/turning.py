# SPDX-License-Identifier: Apache-2.0
"""Images turned upright about their principal point, and what was predicted of them turned back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.types import Camera, DepthPrediction


def roll_rad(down: NDArray[np.float64]) -> float:
    """How far a camera is rolled in whose frame gravity points along ``down (3,)``: the angle of "down" in
    the image from its vertical axis, positive towards the right side."""
    return float(np.arctan2(down[0], down[1]))


def turned(image_rgb: NDArray[np.uint8], camera: Camera, angle_rad: float) -> NDArray[np.uint8]:
    """An image turned about its principal point, its border mirrored."""
    out = _warped(image_rgb, camera, angle_rad, cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.uint8)


def turned_back(
    upright: DepthPrediction, as_taken: DepthPrediction, camera: Camera, roll_rad: float
) -> DepthPrediction:
    """A prediction of an image that was turned by minus its roll, for the image as taken.

    Args:
        as_taken: a prediction for the image as taken. It counts where the turned one was cut off, at the
            level that the turned one has where both see.
    """
    values = _back(upright.values, camera, roll_rad)
    seen = values > 0
    level, both = np.float32(1.0), seen & (as_taken.values > 0)
    if both.any():
        level = np.exp(np.median(np.log(values[both]) - np.log(as_taken.values[both])), dtype=np.float32)
    sigma = as_taken.sigma_log
    if upright.sigma_log is not None and sigma is not None:
        sigma = np.where(seen, _back(upright.sigma_log, camera, roll_rad), sigma)
    return replace(as_taken, values=np.where(seen, values, as_taken.values * level), sigma_log=sigma)


def _back(values: NDArray[np.float32], camera: Camera, angle_rad: float) -> NDArray[np.float32]:
    """0 where the turned image was cut off."""
    out = _warped(values, camera, angle_rad, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return np.asarray(out, dtype=np.float32)


def _warped(
    image: NDArray[Any], camera: Camera, angle_rad: float, interpolation: int, border: int
) -> NDArray[Any]:
    M = cv2.getRotationMatrix2D((camera.cx, camera.cy), np.degrees(angle_rad), 1.0)
    return np.asarray(cv2.warpAffine(image, M, image.shape[1::-1], flags=interpolation, borderMode=border))
