# SPDX-License-Identifier: Apache-2.0
"""The pose of a frame where predicted depth is not believed: landmarks as rays of unknown length."""

from __future__ import annotations

import numpy as np
import pytest

from slamdepth.frontend.pose import pose_from_scratch, refine_pose
from slamdepth.frontend.ray_pose import RaySighting, pose_with_depths
from slamdepth.frontend.ray_start import pose_from_rays
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.tracking.local_mapper import ray_covariance
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)
STEP = np.array([0.35, -0.05, 0.1, 0.02, -0.12, 0.03])
SIGMA_LOG, INFLATION = 0.3, 6.0


def errors(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two ``T_camera_world``."""
    D = invert(estimate) @ truth
    return float(np.linalg.norm(D[:3, 3])), float(np.degrees(rotation_angle_rad(D[:3, :3])))


def terrace(near: int, far: int, seed: int = 0) -> tuple[np.ndarray, RaySighting, np.ndarray]:
    """A parapet that is predicted well and a city that is predicted three metres away.

    Returns:
        Pixels ``(N, 2)`` in the reference, which is the origin; the landmarks as seen after the step; its
        true pose.
    """
    rng = np.random.default_rng(seed)
    n = near + far
    reference_px = rng.uniform((150, 30), (610, 450), (n, 2))
    true_m = np.concatenate([rng.uniform(1.5, 3.0, near), rng.uniform(80.0, 400.0, far)])
    predicted_m = np.concatenate([true_m[:near] * np.exp(0.05 * rng.normal(size=near)), np.full(far, 3.0)])
    T = se3_exp(STEP)
    px, _ = project(CAMERA, transform(T, backproject(CAMERA, reference_px, true_m)))
    px += 0.5 * rng.normal(size=px.shape)
    points = backproject(CAMERA, reference_px, predicted_m)
    covariance = ray_covariance(CAMERA, reference_px, points, np.full(n, SIGMA_LOG), np.ones(n))
    seen = RaySighting(points, covariance, px, np.ones(n), np.zeros((n, 3)), np.full(n, INFLATION))
    return reference_px, seen, T


@pytest.mark.parametrize(("near", "far"), [(60, 240), (40, 360)])
def test_a_city_predicted_at_three_metres_does_not_hide_the_step(near: int, far: int) -> None:
    reference_px, seen, T = terrace(near, far)
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
    _, seen, T = terrace(near=200, far=0)
    usual = refine_pose(CAMERA, T, seen.points_w, seen.covariance_w, seen.px, seen.sigma_px)
    found = pose_with_depths(CAMERA, T, seen)
    assert np.linalg.norm(errors(found.T_camera_world, usual.T_camera_world)) < 0.05
    assert found.inliers.mean() > 0.9


def test_the_pose_errs_no_more_than_its_information_says() -> None:
    """Over many draws; pixels err by half of their deviation, depths of the parapet by a sixth."""
    squared = []
    for seed in range(20):
        _, seen, T = terrace(near=80, far=80, seed=seed)
        found = pose_with_depths(CAMERA, T, seen)
        D = found.T_camera_world @ invert(T)
        twist = np.concatenate([D[:3, 3], [D[2, 1], D[0, 2], D[1, 0]]])
        squared.append(twist @ found.information @ twist)
    assert 0.3 < np.mean(squared) < 6.0


def test_matches_of_two_places_are_no_placement() -> None:
    reference_px, seen, _ = terrace(near=60, far=240)
    rng = np.random.default_rng(1)
    elsewhere = RaySighting(
        seen.points_w, seen.covariance_w, rng.uniform((0, 0), (640, 480), (300, 2)), seen.sigma_px,
        seen.origin_w, seen.inflation,
    )  # fmt: skip
    assert pose_from_rays(CAMERA, np.eye(4), reference_px, elsewhere, seed=0, minimum=30) is None


def test_half_of_the_matches_may_be_wrong() -> None:
    reference_px, seen, T = terrace(near=150, far=150)
    rng = np.random.default_rng(1)
    wrong = rng.random(300) < 0.5
    px = np.where(wrong[:, None], rng.uniform((0, 0), (640, 480), (300, 2)), seen.px)
    mixed = RaySighting(seen.points_w, seen.covariance_w, px, seen.sigma_px, seen.origin_w, seen.inflation)
    found = pose_from_rays(CAMERA, np.eye(4), reference_px, mixed, seed=0, minimum=30)
    assert found is not None
    assert errors(found[0], T)[0] < 0.2 * np.linalg.norm(STEP[:3])
    assert np.mean(found[1][wrong]) < 0.15


def test_too_few_matches_are_no_placement() -> None:
    reference_px, seen, _ = terrace(near=6, far=0)
    assert pose_from_rays(CAMERA, np.eye(4), reference_px, seen, seed=0, minimum=8) is None
