# SPDX-License-Identifier: Apache-2.0
"""The depth about which the depth of a keyframe is searched for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.dense.completion import REACH_PX, spread
from slamdepth.dense.rectify import Rectifier
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.typing import Bools, Bytes, Floats32

_LEAST_KNOWN = 0.05


@dataclass(frozen=True)
class Sheet:
    """A first depth of every pixel.

    Attributes:
        depth_m: ``(h, w)`` above 0 everywhere.
        is_sensor: ``(h, w)`` where a sensor measured it.
    """

    depth_m: Floats32
    is_sensor: Bools


def first_sheet(
    keyframe: Keyframe, rectifier: Rectifier, positions: Floats32 | None, grey: Bytes
) -> Sheet | None:
    """A keyframe's own depth, its holes filled from around; None where there is hardly any."""
    prediction = keyframe.prediction.load()
    depth = keyframe.in_metres(prediction)
    depth = rectifier.nearest(np.where(np.isfinite(depth), depth, 0.0).astype(np.float32), positions)
    known = depth > 0
    if known.mean() < _LEAST_KNOWN:
        return None
    if not known.all():
        centre = np.float32(np.log(np.median(depth[known])))
        log = np.where(known, np.log(np.where(known, depth, 1.0)) - centre, 0.0)
        filled = spread(log.astype(np.float32), known.astype(np.float32), grey, REACH_PX)
        depth = np.where(known, depth, np.exp(filled + centre)).astype(np.float32)
    return Sheet(depth, known & prediction.is_sensor)
