# SPDX-License-Identifier: Apache-2.0
"""The depth of one keyframe by its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.dense.semi_global import aggregate, best_label
from slamdepth.dense.sweep import View, matching_cost
from slamdepth.types import Camera
from slamdepth.typing import Floats32

_SHARP = 0.1  # rise of the cost two labels beside the best that is as good as any


@dataclass(frozen=True)
class Measured:
    """What the views say.

    Attributes:
        log_ratio: ``(h, w)`` natural log of depth over the sheet.
        evidence: ``(h, w)`` how clearly the images tell it, 0 to 1; 0 where they show no texture.
    """

    log_ratio: Floats32
    evidence: Floats32


def measure(
    keyframe: View, sheet_m: Floats32, views: Sequence[View], camera: Camera, reach_log: float, labels: int
) -> Measured:
    """Search for each pixel's depth about a sheet.

    Args:
        sheet_m: ``(h, w)`` above 0.
        reach_log: how far from it, as the natural log of a ratio.
        labels: number of depths that are tried.
    """
    log_ratios = np.linspace(-reach_log, reach_log, labels).astype(np.float32)
    cost = matching_cost(keyframe, sheet_m, views, camera, log_ratios)
    label, position = best_label(aggregate(cost, keyframe.grey))
    middle = np.clip(label, 2, labels - 3)[None]
    below, at, above = (np.take_along_axis(cost, middle + step, axis=0)[0] for step in (-2, 0, 2))
    evidence = np.clip((below + above - 2.0 * at) / _SHARP, 0.0, 1.0)
    step = 2.0 * reach_log / (labels - 1)
    return Measured(
        (position * np.float32(step) - np.float32(reach_log)).astype(np.float32),
        evidence.astype(np.float32),
    )
