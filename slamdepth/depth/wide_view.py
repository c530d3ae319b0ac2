# SPDX-License-Identifier: Apache-2.0
"""The scale of predicted depth in views wider than any the network was trained on.

A network relies too little on apparent size, so that a wide view looks near to it. Its middle, predicted as
the image of a usual camera, has the right scale, and the whole image takes it over.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamdepth.types import DepthPrediction, Frame

WIDE_DEG = 90.0
"""Views wider than this along their longer side are wide: training images see 57 to 63 degrees."""
USUAL_DEG = 63.0
"""What the middle sees along its longer side."""

_ASPECT = 0.75
_FEWEST_PIXELS = 100


def middle_view(frame: Frame) -> tuple[Frame, tuple[slice, slice]] | None:
    """The middle of a wide frame as the image of a usual camera, and its rows and columns.

    None where the frame is not wide. The optical axis stays, and so does gravity.
    """
    camera = frame.camera
    sides = np.array([camera.width / camera.fx, camera.height / camera.fy])
    if math.degrees(2.0 * math.atan(sides.max() / 2.0)) <= WIDE_DEG:
        return None
    reach = math.tan(math.radians(USUAL_DEG) / 2.0) * np.where(sides >= sides.max(), 1.0, _ASPECT)
    if sides[0] == sides[1]:
        reach[1] *= _ASPECT
    (left, right), (top, bottom) = (
        (max(0, math.ceil(centre - focal * half)), min(size, math.floor(centre + focal * half) + 1))
        for centre, focal, half, size in (
            (camera.cx, camera.fx, reach[0], camera.width),
            (camera.cy, camera.fy, reach[1], camera.height),
        )
    )
    at = slice(top, bottom), slice(left, right)
    cropped = replace(
        camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top
    )
    depth_m = None if frame.depth_m is None else frame.depth_m[at]
    image = np.ascontiguousarray(frame.image_rgb[at])
    return replace(frame, image_rgb=image, camera=cropped, depth_m=depth_m), at


def with_scale_of(
    whole: DepthPrediction, middle: DepthPrediction, at: tuple[slice, slice]
) -> DepthPrediction:
    """``whole`` in metres, multiplied so that it agrees with ``middle`` at its rows and columns ``at``."""
    both = (whole.values[at] > 0) & (middle.values > 0)
    if both.sum() < _FEWEST_PIXELS:
        return whole
    ratio = float(np.median(np.log(middle.values[both]) - np.log(whole.values[at][both])))
    values = (whole.values * np.float32(math.exp(ratio))).astype(np.float32)
    return replace(whole, values=values, scale_sigma_log=middle.scale_sigma_log)
