# SPDX-License-Identifier: Apache-2.0
"""Images rotated upright about their principal point, and predictions for them rotated back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.types import Camera, DepthPrediction
from slamdepth.typing import Bools, Floats, Floats32

_SEAM = 0.05
"""Width of the band in which two predictions are blended, as a share of the image's longer side."""

_COARSE = 8
_WIDER_WEIGHT = 0.02
"""Weight of the wider mean, where that of known pixels is at most 1."""


def roll_rad(gravity: Floats) -> float:
    """Roll of a camera in radians: the angle of gravity in the image from its vertical axis.

    Args:
        gravity: ``(3,)`` in the camera's frame (x right, y down, z forward); an angle towards the right side
            of the image is positive.
    """
    return float(np.arctan2(gravity[0], gravity[1]))


def rotated(image_rgb: NDArray[np.uint8], camera: Camera, angle_rad: float) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)`` rotated about its principal point, its border mirrored.

    An image of a camera with a roll is upright after a rotation by minus that roll.
    """
    out = _warped(image_rgb, camera, angle_rad, cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.uint8)


def rotated_back(
    upright: DepthPrediction, as_taken: DepthPrediction, camera: Camera, roll_rad: float, share: float = 1.0
) -> DepthPrediction:
    """The prediction for an image rotated upright, as one for the image as taken.

    Args:
        upright: metres for every pixel of the image after a rotation by minus ``roll_rad``.
        as_taken: metres for every pixel of the image as taken. It fills in where the rotated image was cut
            off, brought to the scale that the rotated one has nearby, so that there is no step.
        camera: of the image as taken.
        roll_rad: roll of the camera in radians.
        share: weight of the rotated prediction where there are both, 0 to 1.

    Returns:
        Metres, and their uncertainty where both predictions have one.
    """
    rotated_m = _back(upright.values, camera, roll_rad)
    seen = rotated_m > 0
    log_taken = np.log(as_taken.values.astype(np.float64))
    change = np.log(rotated_m.astype(np.float64), out=log_taken.copy(), where=seen) - log_taken
    inside = np.ones(seen.shape)
    if not seen.all():
        to_seam_px = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, 5)
        inside = np.minimum(1.0, to_seam_px / (_SEAM * max(seen.shape)))
        change = inside * change + (1 - inside) * _spread(change, seen)
    values = np.exp(log_taken + share * change).astype(np.float32)
    sigma = as_taken.sigma_log
    if upright.sigma_log is not None and sigma is not None:
        taken, rotated_sigma = sigma.astype(np.float64), _back(upright.sigma_log, camera, roll_rad)
        sigma = (taken + share * inside * (rotated_sigma - taken)).astype(np.float32)
    return replace(as_taken, values=values, sigma_log=sigma, scale_sigma_log=upright.scale_sigma_log)


def _spread(difference: Floats, known: Bools) -> Floats:
    """``difference (H, W)`` smoothed, and extrapolated from the nearest pixels where it is not ``known``."""
    rows, columns = difference.shape
    small = (max(1, columns // _COARSE), max(1, rows // _COARSE))
    weight = cv2.resize(known.astype(np.float64), small, interpolation=cv2.INTER_AREA)
    weighted = cv2.resize(np.where(known, difference, 0.0), small, interpolation=cv2.INTER_AREA)
    out = np.full(weight.shape, np.median(difference[known]))
    for sigma in (small[0] / 4, small[0] / 12):
        total = cv2.GaussianBlur(weight, (0, 0), sigma)
        out = (cv2.GaussianBlur(weighted, (0, 0), sigma) + _WIDER_WEIGHT * out) / (total + _WIDER_WEIGHT)
    return np.asarray(cv2.resize(out, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float64)


def _back(values: Floats32, camera: Camera, angle_rad: float) -> Floats32:
    """A map of the rotated image in the pixels of the image as taken; 0 where the former was cut off."""
    out = _warped(values, camera, angle_rad, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    return np.asarray(out, dtype=np.float32)


def _warped(
    image: NDArray[Any], camera: Camera, angle_rad: float, interpolation: int, border: int
) -> NDArray[Any]:
    M = cv2.getRotationMatrix2D((camera.cx, camera.cy), np.degrees(angle_rad), 1.0)
    return np.asarray(cv2.warpAffine(image, M, image.shape[1::-1], flags=interpolation, borderMode=border))
