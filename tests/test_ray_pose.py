# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame where predicted depth is not believed: landmarks as rays of unknown length."""

from __future__ import annotations

import numpy as np
import pytest
from wide_scene import CAMERA, STEP, elsewhere, errors, half_wrong, terrace

from slamdepth.frontend.pose import pose_from_scratch, refine_pose
from slamdepth.frontend.ray_pose import RaySighting, pose_with_depths
from slamdepth.frontend.ray_start import pose_from_rays
from slamdepth.frontend.wide_pose import Sighting
from slamdepth.geometry import invert

INFLATION = 6.0


def rays(seen: Sighting) -> RaySighting:
    """The landmarks as rays from the reference, which is the origin; their depth is only predicted."""
    count = len(seen.px)
    return RaySighting(
        seen.points_w,
        seen.covariance_w,
        seen.px,
        seen.sigma_px,
        np.zeros((count, 3)),
        np.full(count, INFLATION),
    )


@pytest.mark.parametrize(("near", "far"), [(60, 240), (40, 360)])
def test_a_city_predicted_at_three_metres_does_not_hide_the_step(near: int, far: int) -> None:
    reference_px, sighting, T = terrace(near, far)
    seen = rays(sighting)
    found = pose_from_rays(CAMERA, np.eye(4), reference_px, seen, seed=0, minimum=30)
    assert found is not None
    metres, degrees = errors(found[0], T)
    assert metres < 0.15 * np.linalg.norm(STEP[:3])
    assert degrees < 0.2
    assert found[1].mean() > 0.9
    scratch = pose_from_scratch(CAMERA, seen.points_w, seen.px, seed=0)  # what predicted depths would say
    assert scratch is not None
    usual = refine_pose(CAMERA, scratch[0], seen.points_w, seen.covariance_w, seen.px, seen.sigma_px)
    assert errors(usual.T_camera_world, T)[0] > 3 * metres


def test_depths_that_are_right_are_believed() -> None:
    _, sighting, T = terrace(near=200, far=0)
    seen = rays(sighting)
    usual = refine_pose(CAMERA, T, seen.points_w, seen.covariance_w, seen.px, seen.sigma_px)
    found = pose_with_depths(CAMERA, T, seen)
    assert np.linalg.norm(errors(found.T_camera_world, usual.T_camera_world)) < 0.05
    assert found.inliers.mean() > 0.9


def test_the_pose_errs_no_more_than_its_information_says() -> None:
    """Over many draws; pixels err by half of their deviation, depths of the parapet by a sixth."""
    squared = []
    for seed in range(20):
        _, seen, T = terrace(near=80, far=80, seed=seed)
        found = pose_with_depths(CAMERA, T, rays(seen))
        D = found.T_camera_world @ invert(T)
        twist = np.concatenate([D[:3, 3], [D[2, 1], D[0, 2], D[1, 0]]])
        squared.append(twist @ found.information @ twist)
    assert 0.3 < np.mean(squared) < 6.0


def test_matches_of_two_places_are_no_placement() -> None:
    reference_px, seen, _ = terrace(near=60, far=240)
    other = rays(elsewhere(seen))
    assert pose_from_rays(CAMERA, np.eye(4), reference_px, other, seed=0, minimum=30) is None


def test_half_of_the_matches_may_be_wrong() -> None:
    reference_px, seen, T = terrace(near=150, far=150)
    mixed, wrong = half_wrong(seen)
    found = pose_from_rays(CAMERA, np.eye(4), reference_px, rays(mixed), seed=0, minimum=30)
    assert found is not None
    assert errors(found[0], T)[0] < 0.2 * np.linalg.norm(STEP[:3])
    assert np.mean(found[1][wrong]) < 0.15


def test_too_few_matches_are_no_placement() -> None:
    reference_px, sighting, _ = terrace(near=6, far=0)
    seen = rays(sighting)
    assert pose_from_rays(CAMERA, np.eye(4), reference_px, seen, seed=0, minimum=8) is None
