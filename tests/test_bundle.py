# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment on small exact scenes, and against GTSAM on a noisy one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamdepth.backend import camera_system
from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.backend.bundle_solver import Solver
from slamdepth.backend.sightings import HUBER, Sightings, State
from slamdepth.geometry import invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)


def truth(cameras: int = 6, points: int = 80, seed: int = 0) -> BundleProblem:
    """Cameras side by side before a cloud, every observation exact, two cameras fixed."""
    rng = np.random.default_rng(seed)
    X = rng.uniform((-0.5, -0.7, 2.0), (1.1, 0.7, 4.0), (points, 3))
    step = np.array([-0.12, 0.02, 0.0, 0.0, -0.02, 0.0])
    T = np.stack([se3_exp(k * step + (0.02 * rng.normal(size=6) if k else 0)) for k in range(cameras)])
    obs_camera, obs_point, px, z = [], [], [], []
    for k in range(cameras):
        u, depth = project(CAMERA, transform(T[k], X))
        seen = np.flatnonzero((depth > 0.1) & (rng.random(points) < 0.9))
        obs_camera.append(np.full(len(seen), k))
        obs_point.append(seen)
        px.append(u[seen])
        z.append(depth[seen])
    m = sum(map(len, obs_point))
    fixed = np.zeros(cameras, dtype=bool)
    fixed[:2] = True
    order = rng.permutation(m)  # in no order at all
    return BundleProblem(
        camera=CAMERA,
        T_camera_world=T,
        fixed=fixed,
        points_w=X,
        obs_camera=np.concatenate(obs_camera)[order],
        obs_point=np.concatenate(obs_point)[order],
        px=np.concatenate(px)[order],
        sigma_px=np.ones(m),
        log_depth=np.log(np.concatenate(z)[order]),
        sigma_log=np.full(m, 0.1),
    )


def without_depth(problem: BundleProblem) -> BundleProblem:
    return replace(problem, log_depth=np.full(len(problem.px), np.nan))


def perturbed(problem: BundleProblem, size: float = 0.02, seed: int = 1) -> BundleProblem:
    rng = np.random.default_rng(seed)
    K = len(problem.fixed)
    T = se3_exp(size * rng.normal(size=(K, 6)) * ~problem.fixed[:, None]) @ problem.T_camera_world
    return replace(
        problem, T_camera_world=T, points_w=problem.points_w + size * rng.normal(size=problem.points_w.shape)
    )


def terrace(doubt: float) -> BundleProblem:
    """Half of the points are a city 100 to 300 m away that is predicted, and starts, at 3 m."""
    exact = truth(points=160)
    far = np.arange(160) % 2 == 1
    rng = np.random.default_rng(4)
    X = exact.points_w * np.where(far[:, None], rng.uniform(50, 100, (160, 1)), 1.0)
    at = X[exact.obs_point]
    seen = np.einsum("nij,nj->ni", exact.T_camera_world[exact.obs_camera][:, :3, :3], at)
    px, depth = project(CAMERA, seen + exact.T_camera_world[exact.obs_camera][:, :3, 3])
    log_depth = np.where(far[exact.obs_point], np.log(3.0), np.log(np.maximum(depth, 0.1)))
    start = np.where(far[:, None], X / np.linalg.norm(X, axis=1)[:, None] * 3.0, X)
    return replace(
        exact, px=px, points_w=start, log_depth=log_depth, sigma_log=np.full(len(px), 0.1 * 6), doubt=doubt
    )


def test_a_doubted_prior_does_not_bend_the_cameras() -> None:
    exact = truth(points=160)
    errors = []
    for doubt in (1.0, 6.0):
        found = bundle_adjust(terrace(doubt), (5, 5))
        D = np.stack([invert(a) @ b for a, b in zip(found.T_camera_world, exact.T_camera_world, strict=True)])
        errors.append(float(np.linalg.norm(D[:, :3, 3], axis=1).max()))
    believed, doubted = errors
    assert doubted < 0.002
    assert believed > 5 * doubted


def test_points_are_placed_without_moving_cameras() -> None:
    problem = terrace(6.0)
    solver = Solver(problem, Sightings(problem))
    state = State(problem.T_camera_world, problem.points_w, np.zeros(len(problem.fixed)), 0.0)
    placed = solver.place_points(state)
    np.testing.assert_array_equal(placed.T, problem.T_camera_world)
    far = np.arange(160) % 2 == 1
    assert np.median(np.linalg.norm(placed.X[far], axis=1)) > 30.0


def noisy(problem: BundleProblem, sigma_px: float, seed: int = 2) -> BundleProblem:
    rng = np.random.default_rng(seed)
    return replace(problem, px=problem.px + sigma_px * rng.normal(size=problem.px.shape))


def pose_error(T: np.ndarray, T_true: np.ndarray) -> float:
    D = invert(T) @ T_true
    return float(max(np.linalg.norm(D[:, :3, 3], axis=1).max(), rotation_angle_rad(D[:, :3, :3]).max()))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_depth", [False, True])
def test_exact_observations_lead_to_the_truth(seed: int, with_depth: bool) -> None:
    exact = truth(seed=seed)
    if not with_depth:
        exact = without_depth(exact)
    result = bundle_adjust(perturbed(exact, seed=seed), iterations=(10, 10))
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 1e-6
    np.testing.assert_allclose(result.points_w, exact.points_w, atol=1e-5)
    assert result.final_cost < 1e-6 < result.initial_cost
    assert result.inlier.all()
    assert result.iterations <= 20
    np.testing.assert_array_equal(result.log_scale, 0.0)


def test_fixed_cameras_stay_and_arguments_are_left_alone() -> None:
    problem = noisy(perturbed(replace(truth(), sigma_scale=0.1)), 1.0)
    before = [a.copy() for a in (problem.T_camera_world, problem.points_w, problem.px)]
    result = bundle_adjust(problem)
    np.testing.assert_array_equal(result.T_camera_world[:2], before[0][:2])
    assert pose_error(result.T_camera_world[2:], before[0][2:]) > 1e-4
    for a, b in zip(before, (problem.T_camera_world, problem.points_w, problem.px), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_readout_time_is_found_with_its_uncertainty() -> None:
    """Pixels moved by 20 ms of a rolling shutter, each camera's in its own way."""
    exact = truth()
    rng = np.random.default_rng(7)
    speed = rng.normal(0, 300.0, (len(exact.fixed), 2))
    phase = exact.px[:, 1:] / CAMERA.height - 0.5
    rate = speed[exact.obs_camera] * phase
    problem = replace(perturbed(replace(exact, px=exact.px - 0.02 * rate)), px_rate=rate)
    result = bundle_adjust(problem, iterations=(10, 10))
    assert result.readout_s == pytest.approx(0.02, abs=1e-6)
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 1e-6
    found = [bundle_adjust(noisy(problem, 0.5, seed), (10, 10)) for seed in range(8)]
    errors = np.array([r.readout_s - 0.02 for r in found])
    sigma_s = np.array([r.readout_sigma_s for r in found])
    assert 0.4 < np.sqrt(np.mean((errors / (0.5 * sigma_s)) ** 2)) < 2.0  # sigma_px says 1, noise is 0.5
    assert bundle_adjust(exact).readout_sigma_s is None


def test_all_cameras_fixed_leaves_the_points_to_move() -> None:
    exact = without_depth(replace(truth(), fixed=np.ones(6, dtype=bool)))
    start = replace(exact, points_w=exact.points_w + 0.02)
    result = bundle_adjust(start, iterations=(10, 10))
    np.testing.assert_array_equal(result.T_camera_world, exact.T_camera_world)
    np.testing.assert_allclose(result.points_w, exact.points_w, atol=1e-5)


def test_nothing_to_adjust() -> None:
    exact = truth()
    none = np.zeros(0, dtype=np.int64)
    empty = replace(
        exact, obs_camera=none, obs_point=none, px=np.zeros((0, 2)),
        sigma_px=np.zeros(0), log_depth=np.zeros(0), sigma_log=np.zeros(0),
    )  # fmt: skip
    result = bundle_adjust(empty)
    np.testing.assert_allclose(result.T_camera_world, exact.T_camera_world)
    np.testing.assert_allclose(result.points_w, exact.points_w)
    assert result.inlier.shape == (0,)


def test_outliers_are_flagged_and_do_no_harm() -> None:
    exact = without_depth(truth())
    rng = np.random.default_rng(4)
    problem = noisy(perturbed(exact), 0.3)
    wrong = rng.permutation(len(problem.px))[: len(problem.px) // 20]
    heading = rng.uniform(0, 2 * np.pi, len(wrong))
    problem.px[wrong] += 25.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    result = bundle_adjust(problem, iterations=(10, 10))
    assert not result.inlier[wrong].any()
    assert np.delete(result.inlier, wrong).mean() > 0.99
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 0.01
    clean = np.delete(result.chi2, wrong)
    assert np.median(clean) < 1.0


def test_points_behind_a_camera_are_outliers() -> None:
    exact = truth()
    problem = replace(exact, points_w=exact.points_w.copy())
    at = int(exact.obs_point[0])
    problem.points_w[at] = [0.0, 0.0, -2.0]
    result = bundle_adjust(problem, iterations=(1, 1))
    seen = exact.obs_point == at
    assert not result.inlier[seen].any()
    assert np.isfinite(result.points_w).all()
    assert np.isfinite(result.T_camera_world).all()


def test_agrees_with_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")
    problem = noisy(perturbed(without_depth(truth())), 1.0)
    problem.px[::25] += 8.0  # enough to reach Huber's linear part
    ours = bundle_adjust(problem, iterations=(30,) * 10, gate=np.inf)

    K = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    )
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    T_world_camera = invert(problem.T_camera_world)
    for k, T in enumerate(T_world_camera):
        initial.insert(k, gtsam.Pose3(T))
        if problem.fixed[k]:
            graph.push_back(gtsam.NonlinearEqualityPose3(k, gtsam.Pose3(T)))
    for p, X in enumerate(problem.points_w):
        initial.insert(1000 + p, X)
    for k, p, px in zip(problem.obs_camera, problem.obs_point, problem.px, strict=True):
        graph.push_back(gtsam.GenericProjectionFactorCal3_S2(px, noise, int(k), 1000 + int(p), K))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()

    assert ours.initial_cost == pytest.approx(2.0 * graph.error(initial), rel=1e-9)
    assert ours.final_cost == pytest.approx(2.0 * graph.error(theirs), rel=1e-6)
    poses = np.stack([theirs.atPose3(k).matrix() for k in range(len(T_world_camera))])
    np.testing.assert_allclose(invert(ours.T_camera_world), poses, atol=2e-5)
    points = np.stack([theirs.atPoint3(1000 + p) for p in range(len(problem.points_w))])
    assert np.median(np.linalg.norm(ours.points_w - points, axis=1)) < 2e-5


def test_a_common_depth_error_goes_into_the_scale_of_its_keyframe() -> None:
    exact = truth()
    wrong = np.array([0.0, 0.2, 0.0, -0.15, 0.0, 0.1])
    problem = replace(perturbed(exact), log_depth=exact.log_depth - wrong[exact.obs_camera], sigma_scale=0.3)
    result = bundle_adjust(problem, iterations=(10, 10))
    np.testing.assert_allclose(result.log_scale, wrong, atol=0.01)
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 3e-3
    believed = bundle_adjust(replace(problem, sigma_scale=0.0), iterations=(10, 10))
    assert pose_error(believed.T_camera_world, exact.T_camera_world) > pose_error(
        result.T_camera_world, exact.T_camera_world
    )


def test_one_prediction_wrong_by_any_factor_does_not_shrink_the_map() -> None:
    exact = truth()
    few = replace(exact, sigma_log=np.full(len(exact.px), 1.5), sigma_scale=0.1)
    errors = []
    for factor in (1.5, 20.0):  # a city predicted at three metres
        wrong = exact.log_depth - np.log(factor) * (exact.obs_camera == 3)
        problem = replace(noisy(perturbed(few), 1.0), log_depth=wrong)
        result = bundle_adjust(problem, iterations=(10, 10))
        errors.append(pose_error(result.T_camera_world, exact.T_camera_world))
    assert errors[1] < 1.2 * errors[0]


def test_depth_gives_the_scale_where_one_camera_is_fixed() -> None:
    exact = truth()
    one = replace(exact, fixed=np.arange(6) == 0, sigma_log=np.full(len(exact.px), 0.02))
    shrunk = replace(one, points_w=0.8 * one.points_w, T_camera_world=one.T_camera_world.copy())
    shrunk.T_camera_world[:, :3, 3] *= 0.8
    result = bundle_adjust(shrunk, iterations=(20, 20))
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 2e-3


def test_a_wild_depth_is_outvoted() -> None:
    exact = truth()
    problem = perturbed(exact)
    log_depth = exact.log_depth.copy()
    log_depth[::7] += 1.5
    result = bundle_adjust(replace(problem, log_depth=log_depth), iterations=(10, 10))
    assert pose_error(result.T_camera_world, exact.T_camera_world) < 2e-3
    assert result.inlier.mean() > 0.99


@pytest.mark.parametrize("sigma_scale", [0.0, 0.2])
def test_cameras_may_be_taken_by_groups_and_solved_by_iteration(
    monkeypatch: pytest.MonkeyPatch, sigma_scale: float
) -> None:
    problem = noisy(perturbed(replace(truth(), sigma_scale=sigma_scale)), 0.5)
    monkeypatch.setattr(camera_system, "_GROUP", 100)
    dense = bundle_adjust(problem)
    monkeypatch.setattr(camera_system, "_GROUP", 14)
    for most, atol in ((400, 1e-9), (0, 1e-6)):
        monkeypatch.setattr(camera_system, "_DENSE_CAMERAS", most)
        monkeypatch.setattr(camera_system, "_CLUSTER", 2)
        other = bundle_adjust(problem)
        np.testing.assert_allclose(other.T_camera_world, dense.T_camera_world, atol=atol)
        np.testing.assert_allclose(other.points_w, dense.points_w, atol=10 * atol)


def test_the_order_of_observations_does_not_matter() -> None:
    problem = noisy(perturbed(truth()), 0.5)
    order = np.random.default_rng(0).permutation(len(problem.px))
    names = ("obs_camera", "obs_point", "px", "sigma_px", "log_depth", "sigma_log")
    other = bundle_adjust(replace(problem, **{name: getattr(problem, name)[order] for name in names}))
    result = bundle_adjust(problem)
    np.testing.assert_allclose(other.points_w, result.points_w, atol=1e-9)
    np.testing.assert_array_equal(other.inlier, result.inlier[order])


def test_covariance_of_points_is_their_scatter() -> None:
    """Monte Carlo over pixel noise, all poses fixed, since the covariance is given the poses."""
    exact = without_depth(replace(truth(points=30), fixed=np.ones(6, dtype=bool)))
    results = [bundle_adjust(noisy(exact, 1.0, seed), iterations=(10,), gate=np.inf) for seed in range(300)]
    many = np.bincount(exact.obs_point, minlength=30) >= 4
    scatter = np.stack([r.points_w for r in results])[:, many] - exact.points_w[many]
    predicted = results[0].covariance_w[many]
    L = np.linalg.inv(np.linalg.cholesky(predicted))
    whitened = np.einsum("pij,npj->npi", L, scatter)
    spread = np.mean(whitened**2, axis=(0, 1))
    # Huber's kernel throws a little of the information away (and counts it out)
    np.testing.assert_allclose(spread, 1.0, atol=0.25)
