# SPDX-License-Identifier: Apache-2.0
"""What goes into bundle adjustment, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Ints


@dataclass(frozen=True)
class BundleProblem:
    """What is to be adjusted.

    Attributes:
        camera: pinhole; distortion is ignored, pixels are undistorted.
        T_camera_world: ``(K, 4, 4)``; fixed: ``(K,)`` poses that must not move.
        points_w: ``(P, 3)`` metres.
        obs_camera, obs_point: ``(M,)`` indices; a camera sees a point at most once.
        px: ``(M, 2)``; sigma_px: ``(M,)``.
        log_depth: ``(M,)`` log of the depth prior in metres of the map, NaN where none;
            sigma_log: ``(M,)`` its deviation.
        doubt: factor by which ``sigma_log`` was widened where nothing supports the scale of the predictions,
            else 1. Above 1, a prior that is off by more than about two deviations before the widening
            does not pull (Geman and McClure), and points are placed before cameras move.
        px_rate: ``(M, 2)`` pixels by which a second of readout time moves each measurement;
            None leaves the readout time alone.
        sigma_scale: deviation ``s_a`` of a keyframe's common log depth error; 0 pins
            the scales (sensor depth).
    """

    camera: Camera
    T_camera_world: Floats
    fixed: Bools
    points_w: Floats
    obs_camera: Ints
    obs_point: Ints
    px: Floats
    sigma_px: Floats
    log_depth: Floats
    sigma_log: Floats
    sigma_scale: float = 0.0
    px_rate: Floats | None = None
    doubt: float = 1.0


@dataclass(frozen=True)
class BundleResult:
    """What came out.

    Attributes:
        T_camera_world: ``(K, 4, 4)``; points_w: ``(P, 3)``; log_scale: ``(K,)``.
        covariance_w: ``(P, 3, 3)`` m^2 of each point, given the poses.
        inlier: ``(M,)`` observations that agree.
        chi2: ``(M,)`` squared whitened pixel residuals.
        initial_cost, final_cost: robust cost of the first phase's start and the end.
        iterations: steps taken.
        readout_s: what was added to the readout time; readout_sigma_s: its deviation, None
            where it was left alone.
    """

    T_camera_world: Floats
    points_w: Floats
    log_scale: Floats
    covariance_w: Floats
    inlier: Bools
    chi2: Floats
    initial_cost: float
    final_cost: float
    iterations: int
    readout_s: float = 0.0
    readout_sigma_s: float | None = None

    @staticmethod
    def of_readout(readout_s: float, readout_sigma_s: float | None) -> BundleResult:
        """A result of which only the readout time is remembered."""
        none = np.zeros(0)
        return BundleResult(
            np.zeros((0, 4, 4)),
            np.zeros((0, 3)),
            none,
            np.zeros((0, 3, 3)),
            np.zeros(0, dtype=np.bool_),
            none,
            0.0,
            0.0,
            0,
            readout_s,
            readout_sigma_s,
        )
