# SPDX-License-Identifier: Apache-2.0
"""Measured depth and the sheet in one, with its deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.dense.agreement import Agreement
from slamdepth.dense.completion import spread
from slamdepth.typing import Bools, Bytes, Floats32

_REACH_PX = 60.0
_SENSOR_WEIGHT = 50.0


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
    sheet_sigma: Floats32,
    is_sensor: Bools,
    found_m: Floats32,
    evidence: Floats32,
    agreed: Agreement,
    grey: Bytes,
) -> Fused:
    """Correct the sheet by what several keyframes measured.

    The log ratio of measured depth to the sheet is spread over the image between its edges, so that the relief
    of the sheet fills what no view tells.
    """
    confirmed = agreed.is_confirmed & ~is_sensor
    weight = np.where(confirmed, agreed.agree * evidence, np.float32(0.0))
    weight = np.where(is_sensor, np.float32(_SENSOR_WEIGHT), weight)
    ratio = np.log(found_m / sheet_m) + agreed.mean_log
    ratio = np.where(confirmed, ratio, np.float32(0.0))
    correction, share = spread(ratio, weight, grey, _REACH_PX)
    complete = sheet_m * np.exp(correction)
    sigma = deviation(sheet_sigma, is_sensor, confirmed, agreed.agree, evidence, share)
    with_sensor = bool(is_sensor.any())
    depth = np.where(is_sensor, sheet_m, complete)
    if with_sensor:
        depth = np.where(is_sensor | confirmed, depth, np.float32(0.0))
    return Fused(complete, depth.astype(np.float32), sigma, is_sensor | confirmed)


def deviation(
    sheet_sigma: Floats32, is_sensor: Bools, confirmed: Bools, agree: Floats32, evidence: Floats32, share: Floats32
) -> Floats32:
    measured = np.float32(0.015)
    completed = np.float32(0.03) + sheet_sigma * (1.0 - share)
    sigma = np.where(confirmed, measured, completed)
    return np.where(is_sensor, sheet_sigma, sigma).astype(np.float32)
