# SPDX-License-Identifier: Apache-2.0
"""How far a pose is believed."""

from __future__ import annotations

import numpy as np
import pytest
from tracking_scene import ConstantDepth, Run, colour_only, frames, grey, walk

from slamdepth.geometry import invert
from slamdepth.tracking.pose_uncertainty import GOOD_RAD, pose_quality


@pytest.mark.parametrize("deviations", [(1, 1, 1), (3, 1, 0.2), (1, 0.3, 0.3)])
def test_quality_is_the_probability_of_a_small_error(deviations: tuple[float, float, float]) -> None:
    """Monte Carlo: 2 % of five metres, and two degrees."""
    sigma = np.concatenate([0.05 * np.array(deviations), GOOD_RAD / 3.0 * np.array(deviations)])
    errors = sigma * np.random.default_rng(0).normal(size=(20000, 6))
    within = np.linalg.norm(errors[:, :3], axis=1) < 0.1
    within &= np.linalg.norm(errors[:, 3:], axis=1) < GOOD_RAD
    assert pose_quality(np.diag(sigma**2), 5.0) == pytest.approx(within.mean(), abs=0.03)


def test_quality_lies_between_zero_and_one() -> None:
    assert pose_quality(np.zeros((6, 6)), 2.0) == 1.0
    assert pose_quality(1e-12 * np.eye(6), 2.0) == pytest.approx(1.0)
    assert pose_quality(1e6 * np.eye(6), 2.0) == pytest.approx(0.0, abs=1e-6)


def test_placed_frames_have_a_covariance_that_covers_their_error() -> None:
    run = Run(frames(range(24)))
    errors, squared = [], []
    truth = walk()[1]
    for result in run.results[1:]:
        assert result.T_world_camera is not None
        assert result.covariance is not None
        assert np.linalg.eigvalsh(result.covariance)[0] > 0
        assert result.quality > 0.8
        off = result.T_world_camera[:3, 3] - truth[result.index, :3, 3]
        errors.append(float(np.linalg.norm(off)))
        squared.append(float(off @ np.linalg.solve(result.covariance[:3, :3], off)) / 3.0)
    assert max(errors) < 0.05
    assert np.mean(squared) < 1.5


def test_lost_frames_have_no_quality() -> None:
    run = Run([*frames(range(8), colour_only), *frames(range(8, 12), grey)], ConstantDepth())
    for result in run.results[8:]:
        assert result.T_world_camera is None
        assert result.covariance is None
        assert result.quality == 0.0


def test_a_turned_camera_has_its_covariance_in_the_axes_of_the_world() -> None:
    """Along the optical axis the position is known worse than across it, wherever the camera looks."""
    run = Run(frames(range(40)))
    for result in run.results[10:]:
        assert result.T_world_camera is not None
        assert result.covariance is not None
        R = invert(result.T_world_camera)[:3, :3]
        in_camera = R @ result.covariance[3:, 3:] @ R.T
        assert in_camera[2, 2] < in_camera[0, 0] + in_camera[1, 1]
