# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame after a large step, from landmarks whose predicted depth is grossly wrong."""

from __future__ import annotations

import numpy as np
import pytest
from wide_scene import CAMERA, STEP, elsewhere, errors, half_wrong, terrace

from slamdepth.frontend.pose import pose_from_scratch, refine_pose
from slamdepth.frontend.wide_pose import directional_pose, pose_from_reference


def test_a_city_predicted_at_three_metres_does_not_hide_the_step() -> None:
    reference_px, seen, T = terrace(near=60, far=240)
    found = pose_from_reference(CAMERA, np.eye(4), reference_px, seen, seed=0, minimum=30)
    assert found is not None
    metres, degrees = errors(found[0], T)
    assert metres < 0.1 * np.linalg.norm(STEP[:3])
    assert degrees < 0.2
    assert found[1].mean() > 0.9
    scratch = pose_from_scratch(CAMERA, seen.points_w, seen.px, seed=0)  # what the city alone would say
    assert scratch is not None
    usual = refine_pose(CAMERA, scratch[0], seen.points_w, seen.covariance_w, seen.px, seen.sigma_px)
    assert errors(usual.T_camera_world, T)[0] > 5 * metres


def test_depths_that_are_right_are_believed() -> None:
    _, seen, T = terrace(near=200, far=0)
    usual = refine_pose(CAMERA, T, seen.points_w, seen.covariance_w, seen.px, seen.sigma_px)
    found, is_direction = directional_pose(CAMERA, T, seen)
    assert np.linalg.norm(errors(found.T_camera_world, usual.T_camera_world)) < 0.02
    assert is_direction.mean() < 0.05


@pytest.mark.parametrize("near", [0, 60])
def test_matches_of_two_places_are_no_placement(near: int) -> None:
    reference_px, seen, _ = terrace(near=near, far=300 - near)
    other = elsewhere(seen)
    assert pose_from_reference(CAMERA, np.eye(4), reference_px, other, seed=0, minimum=30) is None


def test_half_of_the_matches_may_be_wrong() -> None:
    reference_px, seen, T = terrace(near=150, far=150)
    mixed, wrong = half_wrong(seen)
    found = pose_from_reference(CAMERA, np.eye(4), reference_px, mixed, seed=0, minimum=30)
    assert found is not None
    assert errors(found[0], T)[0] < 0.15 * np.linalg.norm(STEP[:3])
    assert np.mean(found[1][wrong]) < 0.15


def test_too_few_matches_are_no_placement() -> None:
    reference_px, seen, _ = terrace(near=6, far=0)
    assert pose_from_reference(CAMERA, np.eye(4), reference_px, seen, seed=0, minimum=8) is None
