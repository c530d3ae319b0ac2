# SPDX-License-Identifier: Apache-2.0
"""Measured depth and the sheet in one, with its deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.dense.agreement import Agreement
from slamdepth.dense.completion import REACH_PX, spread
from slamdepth.typing import Bools, Bytes, Floats32

_SENSOR_WEIGHT = 50.0

# deviations of log depth
_SENSOR = 0.01
_LEAST = 0.012
_MATCH_PX = 0.25  # of a match, common to neighbouring pixels and views
_PER_SLOPE = 0.7
_WITHOUT_EVIDENCE = 0.05
_WITHOUT_AGREEMENT = 0.02
_MOST_AGREE = 8.0
_COMPLETED = 0.06
_PER_SLOPE_COMPLETED = 1.5


@dataclass(frozen=True)
class Fused:
    """Depth of a keyframe.

    Attributes:
        complete_m: ``(h, w)`` above 0 everywhere.
        depth_m: ``(h, w)``, 0 where it is not known well enough to be of use.
        sigma_log: ``(h, w)`` deviation of its natural log.
        is_measured: ``(h, w)`` where views or a sensor measured it.
    """

    complete_m: Floats32
    depth_m: Floats32
    sigma_log: Floats32
    is_measured: Bools


def fuse(
    sheet_m: Floats32,
    is_sensor: Bools,
    found_m: Floats32,
    evidence: Floats32,
    agreed: Agreement,
    grey: Bytes,
    parallax_px: float,
) -> Fused:
    """Correct the sheet by what several keyframes measured.

    The log ratio of measured depth to the sheet is spread over the image between its edges, so that the
    relief of the sheet fills what no view tells.

    Args:
        parallax_px: shift of the images of the views per unit of log depth, in pixels.
    """
    confirmed = agreed.is_confirmed & ~is_sensor
    weight = np.where(confirmed, agreed.agree * evidence, np.float32(0.0))
    weight = np.where(is_sensor, np.float32(_SENSOR_WEIGHT), weight)
    found = np.log(found_m / sheet_m)
    ratio = np.where(confirmed, found + agreed.mean_log, np.float32(0.0))
    correction = spread(ratio, weight, grey, REACH_PX)
    complete = sheet_m * np.exp(correction)
    off = np.where(confirmed, ratio, found) - correction
    sigma = _deviation(confirmed, agreed.agree, evidence, off, complete, parallax_px)
    sigma = np.where(is_sensor, np.float32(_SENSOR), sigma)
    depth = np.where(is_sensor, sheet_m, complete)
    if is_sensor.any():
        depth = np.where(is_sensor | confirmed, depth, np.float32(0.0))
    return Fused(complete, depth.astype(np.float32), sigma.astype(np.float32), is_sensor | confirmed)


def _deviation(
    confirmed: Bools,
    agree: Floats32,
    evidence: Floats32,
    off: Floats32,
    depth_m: Floats32,
    parallax_px: float,
) -> Floats32:
    """Deviation of log depth, by what errors of two rendered rooms and a kitchen follow.

    Args:
        off: log ratio of what was measured to what is taken, whether it was confirmed or not.
        depth_m: what is taken.
        parallax_px: see :func:`fuse`.
    """
    slope = _range(np.log(depth_m))
    measured = (
        _LEAST**2
        + (_MATCH_PX / max(parallax_px, 1e-3)) ** 2
        + (_PER_SLOPE * slope) ** 2
        + (_WITHOUT_EVIDENCE * (1.0 - evidence)) ** 2
        + (_WITHOUT_AGREEMENT * (1.0 - agree / _MOST_AGREE)) ** 2
        + off**2
    )
    completed = _COMPLETED**2 + (_PER_SLOPE_COMPLETED * slope) ** 2 + off**2
    return np.asarray(np.sqrt(np.where(confirmed, measured, completed)), np.float32)


def _range(values: Floats32) -> Floats32:
    """Largest less smallest value within two pixels: high at edges of depth."""
    import cv2

    window = np.ones((5, 5), np.uint8)
    return np.asarray(cv2.dilate(values, window) - cv2.erode(values, window), np.float32)
