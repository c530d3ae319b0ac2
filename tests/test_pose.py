# SPDX-License-Identifier: Apache-2.0
"""The pose of one camera, from points known exactly and from points of uncertain depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.frontend.pose import (
    PoseEstimate,
    pixel_covariance,
    pose_covariance,
    pose_from_scratch,
    refine_pose,
)
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, so3_log, transform
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)
SHIFT = np.array([0.15, -0.05, 0.1, 0.03, -0.05, 0.02])


def scene(n: int = 120, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) before the first camera, and the pose of a second one that sees most of them."""
    rng = np.random.default_rng(seed)
    px = rng.uniform((30, 30), (610, 450), (n, 2))
    return backproject(CAMERA, px, rng.uniform(1.0, 4.0, n)), se3_exp(SHIFT)


def errors(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two ``T_camera_world``."""
    D = invert(estimate) @ truth
    return float(np.linalg.norm(D[:3, 3])), float(np.degrees(rotation_angle_rad(D[:3, :3])))


def refine(T0: np.ndarray, X: np.ndarray, px: np.ndarray, **more: Any) -> PoseEstimate:
    n = len(X)
    covariance = more.pop("covariance", np.zeros((n, 3, 3)))
    return refine_pose(CAMERA, T0, X, covariance, px, np.ones(n), **more)


@given(st.integers(0, 1000))
@settings(max_examples=25)
def test_exact_points_give_the_exact_pose(seed: int) -> None:
    X, T = scene(60, seed)
    px, _ = project(CAMERA, transform(T, X))
    start = se3_exp(0.05 * np.random.default_rng(seed).normal(size=6)) @ T
    estimate = refine(start, X, px)
    np.testing.assert_allclose(estimate.T_camera_world, T, atol=1e-8)
    assert estimate.inliers.all()


def test_arguments_are_left_alone() -> None:
    X, T = scene()
    px, _ = project(CAMERA, transform(T, X))
    start = np.eye(4)
    refine(start, X, px + 0.3)
    np.testing.assert_array_equal(start, np.eye(4))


@pytest.mark.parametrize("seed", range(5))
def test_two_in_five_matches_may_be_wrong(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, T = scene(200, seed)
    px, _ = project(CAMERA, transform(T, X))
    px += 0.5 * rng.normal(size=px.shape)
    wrong = rng.permutation(200)[:80]
    # a wrong match lies within the search area of the right one
    heading = rng.uniform(0, 2 * np.pi, 80)
    px[wrong] += rng.uniform(12, 40, (80, 1)) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    estimate = refine(se3_exp(0.03 * rng.normal(size=6)) @ T, X, px, rounds=5)
    metres, degrees = errors(estimate.T_camera_world, T)
    assert metres < 0.01
    assert degrees < 0.15
    assert not estimate.inliers[wrong].any()
    assert estimate.inliers.sum() >= 0.9 * 120


def test_information_predicts_the_scatter() -> None:
    """Monte Carlo: the inverse of the information is the covariance of the estimate."""
    X, T = scene(80)
    px, _ = project(CAMERA, transform(T, X))
    rng = np.random.default_rng(0)
    scatter, information = [], np.zeros((6, 6))
    for _ in range(300):
        estimate = refine(T, X, px + rng.normal(size=px.shape), gate=np.inf)
        D = estimate.T_camera_world @ invert(T)
        scatter.append(np.concatenate([D[:3, 3], so3_log(D[:3, :3])]))
        information = estimate.information
    predicted = np.linalg.inv(information)
    whitened = np.linalg.inv(np.linalg.cholesky(predicted)) @ np.cov(np.array(scatter).T)
    whitened = whitened @ np.linalg.inv(np.linalg.cholesky(predicted)).T
    np.testing.assert_allclose(np.linalg.eigvalsh(whitened), 1.0, atol=0.45)


def scatter_over_prediction(noise: Any, runs: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Monte Carlo with errors ``noise(px, rng) (n, 2)``: eigenvalues of the scatter of poses over the
    prediction of :func:`pose_covariance`, and over the inverse of the information."""
    X, T = scene(400)
    px, _ = project(CAMERA, transform(T, X))
    rng = np.random.default_rng(0)
    none, one = np.zeros((len(X), 3, 3)), np.ones(len(X))
    scatter, predicted, information = [], np.zeros((6, 6)), np.zeros((6, 6))
    for _ in range(runs):
        noisy = px + noise(px, rng)
        estimate = refine(T, X, noisy, gate=np.inf, rounds=2)
        D = invert(estimate.T_camera_world), invert(T)
        moved = D[0][:3, 3] - D[1][:3, 3]
        scatter.append(np.concatenate([moved, so3_log(D[0][:3, :3] @ D[1][:3, :3].T)]))
        covariance = pose_covariance(CAMERA, estimate.T_camera_world, X, none, noisy, one)
        assert covariance is not None
        predicted += covariance / runs
        information += estimate.information / runs
    empirical = np.cov(np.array(scatter).T)
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T[:3, :3].T
    naive = axes @ np.linalg.inv(information) @ axes.T
    whitened = [np.linalg.solve(covariance, empirical) for covariance in (predicted, naive)]
    return np.linalg.eigvals(whitened[0]).real, np.linalg.eigvals(whitened[1]).real


def test_independent_errors_scatter_by_a_known_part_of_the_covariance() -> None:
    """Hessian and scatter of the cells agree, so that the sum is twice the truth, and inflated by three."""
    ratio, naive = scatter_over_prediction(lambda px, rng: rng.normal(size=px.shape))
    np.testing.assert_allclose(6.0 * ratio, 1.0, atol=0.45)
    np.testing.assert_allclose(naive, 1.0, atol=0.45)


def test_errors_that_neighbours_share_make_the_covariance_grow() -> None:
    """Each cell of the image is off as a whole, by half a pixel: the Hessian sees a fifth of it."""

    def by_cell(px: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        cell = np.floor(px / [80.0, 60.0]).astype(int)
        shared = rng.normal(size=(16, 16, 2))
        return np.asarray(shared[cell[:, 0] + 4, cell[:, 1] + 4] + 0.3 * rng.normal(size=px.shape))

    ratio, naive = scatter_over_prediction(by_cell)
    assert naive.mean() > 4.0
    assert (ratio < 1.0).all()
    assert ratio.mean() > 0.15


def test_the_covariance_is_of_the_camera_in_the_world() -> None:
    """Matches of points ahead: the sideways position and the turn about the vertical go together, and the
    axes are those of the world however the world is turned."""
    X, T = scene(200)
    px, _ = project(CAMERA, transform(T, X))
    px += np.random.default_rng(3).normal(size=px.shape)
    none, one = np.zeros((len(X), 3, 3)), np.ones(len(X))
    covariance = pose_covariance(CAMERA, T, X, none, px, one)
    turned = se3_exp(np.array([5.0, -3.0, 2.0, 0.4, 1.1, -0.7]))
    again = pose_covariance(CAMERA, T @ invert(turned), transform(turned, X), none, px, one)
    assert covariance is not None
    assert again is not None
    axes = np.kron(np.eye(2), turned[:3, :3])
    np.testing.assert_allclose(again, axes @ covariance @ axes.T, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_matches_that_do_not_determine_a_pose_have_no_covariance() -> None:
    X, T = scene(60)
    px, _ = project(CAMERA, transform(T, X))
    none, one = np.zeros((60, 3, 3)), np.ones(60)
    assert pose_covariance(CAMERA, T, X[:5], none[:5], px[:5], one[:5]) is None
    same = np.repeat(X[:1], 60, axis=0)
    assert pose_covariance(CAMERA, T, same, none, np.repeat(px[:1], 60, axis=0), one) is None


def test_matches_in_one_corner_leave_a_larger_covariance() -> None:
    X, T = scene(400)
    px, _ = project(CAMERA, transform(T, X))
    rng = np.random.default_rng(0)
    px += 0.5 * rng.normal(size=px.shape)
    corner = np.flatnonzero((px < [200, 160]).all(axis=1))
    spread = rng.permutation(400)[: len(corner)]
    none, one = np.zeros((400, 3, 3)), np.ones(400)
    of = [pose_covariance(CAMERA, T, X[at], none[at], px[at], one[at]) for at in (corner, spread)]
    assert of[0] is not None
    assert of[1] is not None
    assert np.trace(of[0]) > 3.0 * np.trace(of[1])


def along_ray(X: np.ndarray, sigma_log: float, across_m: float = 1e-3) -> np.ndarray:
    """Covariance of points that the camera at the origin saw with an uncertain depth."""
    along = X * sigma_log
    return along[:, :, None] * along[:, None, :] + across_m**2 * np.eye(3)


def test_uncertain_depth_wrong_by_a_third_leaves_the_rotation_alone() -> None:
    """What is sure, the epipolar geometry, decides; the wrong, common scale only scales the step."""
    X, T = scene(200)
    px, _ = project(CAMERA, transform(T, X))
    wrong = 1.3 * X
    estimate = refine(np.eye(4), wrong, px, covariance=along_ray(wrong, 0.3))
    metres, degrees = errors(estimate.T_camera_world, T)
    assert degrees < 0.05
    assert estimate.inliers.mean() > 0.95
    t, t_true = estimate.T_camera_world[:3, 3], T[:3, 3]
    cosine = t @ t_true / np.linalg.norm(t) / np.linalg.norm(t_true)
    assert cosine > 0.999
    assert np.linalg.norm(t) / np.linalg.norm(t_true) == pytest.approx(1.3, abs=0.1)
    believed = refine(np.eye(4), wrong, px, covariance=along_ray(wrong, 1e-3))
    assert metres < 1.3 * errors(believed.T_camera_world, T)[0]


def test_independent_depth_errors_average_out() -> None:
    """Each point's depth off on its own by 30 %: taken as exact, they falsify the pose; weighted, hardly."""
    X, T = scene(300)
    px, _ = project(CAMERA, transform(T, X))
    px += 0.5 * np.random.default_rng(1).normal(size=px.shape)
    noisy = X * np.exp(0.3 * np.random.default_rng(0).normal(size=(300, 1)))
    weighted = refine(np.eye(4), noisy, px, covariance=along_ray(noisy, 0.3))
    naive = refine(np.eye(4), noisy, px)
    for better, worse in zip(
        errors(weighted.T_camera_world, T), errors(naive.T_camera_world, T), strict=True
    ):
        assert better < 0.45 * worse
    assert errors(weighted.T_camera_world, T)[1] < 0.5
    assert weighted.inliers.mean() > 0.85
    assert naive.inliers.mean() < 0.5


def test_points_behind_and_too_few_points() -> None:
    X, T = scene(60)
    px, _ = project(CAMERA, transform(T, X))
    X[:10] = transform(invert(T), np.array([[0.0, 0.0, -1.0]]))
    estimate = refine(T, X, px)
    assert not estimate.inliers[:10].any()
    assert errors(estimate.T_camera_world, T)[0] < 1e-6
    for n in (0, 3):
        few = refine(T, X[20 : 20 + n], px[20 : 20 + n])
        np.testing.assert_array_equal(few.T_camera_world, T)
        assert few.inliers.shape == (n,)


def test_pixel_covariance_is_carried_through_the_projection() -> None:
    X, T = scene(5)
    P = transform(T, X)
    J = np.empty((5, 2, 3))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        J[:, :, axis] = (project(CAMERA, P + step)[0] - project(CAMERA, P - step)[0]) / 2e-6
    J = J @ T[:3, :3]
    covariance = along_ray(X, 0.2)
    S = pixel_covariance(CAMERA, T, P, covariance, np.full(5, 2.0))
    expected = J @ covariance @ np.swapaxes(J, 1, 2) + 4.0 * np.eye(2)
    np.testing.assert_allclose(S, expected, rtol=1e-6, atol=1e-6)


def test_pose_from_scratch() -> None:
    X, T = scene(150)
    px, _ = project(CAMERA, transform(T, X))
    rng = np.random.default_rng(7)
    px[:60] = rng.uniform((0, 0), (640, 480), (60, 2))
    first = pose_from_scratch(CAMERA, X, px, seed=3)
    again = pose_from_scratch(CAMERA, X, px, seed=3)
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert errors(first[0], T)[0] < 1e-3
    assert first[1][60:].all()
    assert first[1][:60].sum() <= 3


def test_pose_from_scratch_of_too_little() -> None:
    X, T = scene(150)
    px, _ = project(CAMERA, transform(T, X))
    assert pose_from_scratch(CAMERA, X[:11], px[:11], seed=0) is None
    assert pose_from_scratch(CAMERA, X[:0], px[:0], seed=0) is None
    noise = np.random.default_rng(7).uniform((0, 0), (640, 480), (150, 2))
    assert pose_from_scratch(CAMERA, X, noise, seed=0, minimum=30) is None
