# SPDX-License-Identifier: Apache-2.0
"""The scale and gravity of a finished map from inertial data."""

from __future__ import annotations

import math

from slamdepth.io.imu import ImuData
from slamdepth.report import ScaleSource
from slamdepth.scale.estimate import ScaleEstimate
from slamdepth.scale.inertial import InertialFit, align_inertial
from slamdepth.types import Trajectory

SENSOR_SIGMA_LOG = 0.01
"""Standard deviation of the log of the scale of a consumer accelerometer that was not calibrated."""


def from_imu(trajectory: Trajectory, imu: ImuData) -> tuple[ScaleEstimate, InertialFit]:
    """Compare the path of a finished map with inertial data.

    Raises:
        DatasetError: they do not fit together, or the motion does not tell the scale.
    """
    fit = align_inertial(trajectory, imu)
    reversed_ = ", with accelerations for specific forces" if fit.is_reversed else ""
    how = (
        f"inertial data over {fit.windows} windows (time offset {fit.offset_s:.3f} s{reversed_}) against the "
        "accelerations of the path"
    )
    sigma_log = math.hypot(SENSOR_SIGMA_LOG, fit.sigma_log)
    return ScaleEstimate(ScaleSource.IMU, fit.scale, sigma_log, how), fit
