# SPDX-License-Identifier: Apache-2.0
"""The scale of a finished map from the known height of the camera over a floor or a road."""

from __future__ import annotations

import math

from slamdepth.errors import DatasetError
from slamdepth.mapping.floor import MAX_TILT_DEG, find_floor
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import ScaleSource
from slamdepth.scale.estimate import ScaleEstimate

HEIGHT_SIGMA_LOG = 0.03
"""Standard deviation of the log of a camera height: how well it is measured, and how level a floor is."""


def from_camera_height(reconstruction: Reconstruction, height_m: float) -> ScaleEstimate:
    """Compare the first camera's known height with that over the floor of the map.

    Args:
        reconstruction: a finished map.
        height_m: the known height in metres.

    Raises:
        DatasetError: no floor is found.
    """
    floor = find_floor(reconstruction)
    is_level = reconstruction.gravity_w is not None
    if floor is None:
        held = "" if is_level else f", the first camera upright to within {MAX_TILT_DEG:g} degrees"
        raise DatasetError(f"no floor was found below the camera (a large level surface{held})")
    level = "level, by gravity as estimated from the images" if is_level else "the first camera's y axis"
    surface = "the ground around each keyframe" if floor.is_mounted else "the lowest large level surface"
    agree = "agree" if floor.is_mounted else "see it"
    how = (
        f"a camera height of {height_m:g} m against {floor.height:.3g} m over {surface} ({floor.keyframes} "
        f"keyframes {agree}), {floor.tilt_deg:.0f} degrees from {level}"
    )
    sigma_log = math.hypot(HEIGHT_SIGMA_LOG, floor.sigma_log)
    return ScaleEstimate(ScaleSource.CAMERA_HEIGHT, height_m / floor.height, sigma_log, how)
