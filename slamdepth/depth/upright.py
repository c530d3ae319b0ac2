# SPDX-License-Identifier: Apache-2.0
"""Images turned upright about their principal point, and what was predicted of them turned back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.types import Camera, DepthPrediction

_SEAM = 0.05
"""Width of the band in which one prediction goes over into the other, in parts of the image's longer side."""

_COARSE = 8
_HOLD = 0.02
"""Weight, beside that of known pixels, of the wider mean."""


def roll_rad(down: NDArray[np.float64]) -> float:
    """How far a camera is rolled in whose frame gravity points along ``down (3,)``: the angle of "down" in
    the image from its vertical axis, positive towards the right side."""
    return float(np.arctan2(down[0], down[1]))


def turned(image_rgb: NDArray[np.uint8], camera: Camera, angle_rad: float) -> NDArray[np.uint8]:
    """An image turned about its principal point, its border mirrored."""
    out = _warped(image_rgb, camera, angle_rad, cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.uint8)


def turned_back(
    upright: DepthPrediction, as_taken: DepthPrediction, camera: Camera, roll_rad: float, share: float = 1.0
) -> DepthPrediction:
    """A prediction of an image that was turned by minus its roll, for the image as taken.

    Args:
        upright, as_taken: metres for every pixel. The latter counts where the turned image was cut off,
            brought to the level that the turned one has nearby, so that there is no step.
        share: how much the turned one counts where both see, 0 to 1, beside the other.
    """
    turned_m = _back(upright.values, camera, roll_rad)
    seen = turned_m > 0
    log_taken = np.log(as_taken.values.astype(np.float64))
    change = np.log(turned_m.astype(np.float64), out=log_taken.copy(), where=seen) - log_taken
    inside = np.ones(seen.shape)
    if not seen.all():
        to_seam_px = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, 5)
        inside = np.minimum(1.0, to_seam_px / (_SEAM * max(seen.shape)))
        change = inside * change + (1 - inside) * _spread(change, seen)
    values = np.exp(log_taken + share * change).astype(np.float32)
    sigma = as_taken.sigma_log
    if upright.sigma_log is not None and sigma is not None:
        taken, turned_sigma = sigma.astype(np.float64), _back(upright.sigma_log, camera, roll_rad)
        sigma = (taken + share * inside * (turned_sigma - taken)).astype(np.float32)
    return replace(as_taken, values=values, sigma_log=sigma)


def _spread(difference: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """``difference (H, W)`` smoothed, and continued to where it is not ``known`` by what is nearest."""
    rows, columns = difference.shape
    small = (max(1, columns // _COARSE), max(1, rows // _COARSE))
    weight = cv2.resize(known.astype(np.float64), small, interpolation=cv2.INTER_AREA)
    weighted = cv2.resize(np.where(known, difference, 0.0), small, interpolation=cv2.INTER_AREA)
    out = np.full(weight.shape, np.median(difference[known]))
    for sigma in (small[0] / 4, small[0] / 12):
        total = cv2.GaussianBlur(weight, (0, 0), sigma)
        out = (cv2.GaussianBlur(weighted, (0, 0), sigma) + _HOLD * out) / (total + _HOLD)
    return np.asarray(cv2.resize(out, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float64)


def _back(values: NDArray[np.float32], camera: Camera, angle_rad: float) -> NDArray[np.float32]:
    """0 where the turned image was cut off."""
    out = _warped(values, camera, angle_rad, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return np.asarray(out, dtype=np.float32)


def _warped(
    image: NDArray[Any], camera: Camera, angle_rad: float, interpolation: int, border: int
) -> NDArray[Any]:
    M = cv2.getRotationMatrix2D((camera.cx, camera.cy), np.degrees(angle_rad), 1.0)
    return np.asarray(cv2.warpAffine(image, M, image.shape[1::-1], flags=interpolation, borderMode=border))
