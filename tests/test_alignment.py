# SPDX-License-Identifier: Apache-2.0
"""Depth predictions fitted to landmarks: correction, uncertainty and dense depth in metres of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slamdepth.depth.alignment import (
    DEFAULT_SIGMA_LOG,
    MAX_ANCHORS,
    DepthField,
    FieldSettings,
    coarse_correction,
    corrected_depth,
    fit_depth_field,
    log_depth_at,
    prior_log_depth_at,
)
from slamdepth.errors import TrackingError
from slamdepth.types import DepthKind, DepthPrediction

WIDTH, HEIGHT = 320, 240


def grid(step: int = 20) -> np.ndarray:
    u, v = np.meshgrid(np.arange(10, WIDTH, step), np.arange(10, HEIGHT, step))
    return np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)


def plane(px: np.ndarray) -> np.ndarray:
    """Log depth of a slanted floor."""
    return np.log(3.0 - 1.5 * px[:, 1] / HEIGHT)


def prediction(values: np.ndarray | None = None, sigma: float | None = 0.2) -> DepthPrediction:
    if values is None:
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        values = np.exp(plane(np.column_stack([u.ravel(), v.ravel()]))).reshape(HEIGHT, WIDTH)
    values = values.astype(np.float32)
    sigma_log = None if sigma is None else np.full(values.shape, sigma, np.float32)
    return DepthPrediction(values, DepthKind.METRIC, sigma_log)


def test_without_landmarks_the_prior_remains() -> None:
    px = grid()
    nothing = np.zeros(0)
    field = fit_depth_field(
        np.zeros((0, 2)), nothing, nothing, nothing, nothing, width=WIDTH, prior_offset=0.1
    )
    sigma = np.full(len(px), 0.2)
    correction, after = field.correction(px, plane(px), sigma)
    assert field.anchors == 0
    np.testing.assert_allclose(correction, 0.1)
    np.testing.assert_allclose(field.mean(px, plane(px), sigma), 0.1)
    np.testing.assert_allclose(after, np.hypot(0.2, FieldSettings().common_sigma))


@pytest.mark.parametrize("offset", [-0.4, 0.05, 0.4])
def test_a_common_factor_is_found_everywhere(offset: float) -> None:
    px = grid(40)
    sigma = np.full(len(px), 0.2)
    field = fit_depth_field(px, plane(px), sigma, plane(px) + offset, np.full(len(px), 0.01), width=WIDTH)
    everywhere = grid(7)
    correction, _ = field.correction(everywhere, plane(everywhere), np.full(len(everywhere), 0.2))
    np.testing.assert_allclose(correction, offset, atol=0.02)
    np.testing.assert_allclose(
        field.mean(everywhere, plane(everywhere), np.full(len(everywhere), 0.2)), correction
    )


def test_a_smooth_bias_is_corrected_and_uncertainty_shrinks_near_landmarks() -> None:
    def bias(px: np.ndarray) -> np.ndarray:
        return 0.15 * np.sin(px[:, 0] / 80.0)

    left = grid(14)
    left = left[left[:, 0] < WIDTH / 2]
    sigma = np.full(len(left), 0.3)
    field = fit_depth_field(
        left, plane(left), sigma, plane(left) + bias(left), np.full(len(left), 0.01), width=WIDTH
    )
    near, far = np.array([[80.0, 120.0]]), np.array([[310.0, 120.0]])
    correction, sigma_near = field.correction(near, plane(near), np.array([0.3]))
    assert correction[0] == pytest.approx(bias(near)[0], abs=0.03)
    _, sigma_far = field.correction(far, plane(far), np.array([0.3]))
    assert sigma_near[0] < 0.6 * sigma_far[0]
    assert sigma_far[0] > 0.8 * 0.3
    assert sigma_near[0] >= np.sqrt(FieldSettings().white_share) * 0.3 - 1e-9  # independent of neighbours
    assert sigma_far[0] < np.hypot(0.3, FieldSettings().common_sigma)


def test_landmarks_on_another_surface_have_little_influence() -> None:
    """A wall behind a chair: the same pixels, another depth, an error of its own."""
    px = np.tile([[160.0, 120.0]], (6, 1)) + np.arange(6.0)[:, None]
    settings = FieldSettings(common_sigma=0.01)
    field = fit_depth_field(
        px, np.log(np.full(6, 1.0)), np.full(6, 0.3), np.log(np.full(6, 1.2)), np.full(6, 0.01),
        width=WIDTH, settings=settings,
    )  # fmt: skip
    at = np.array([[162.0, 122.0]])
    chair, chair_sigma = field.correction(at, np.log([1.0]), np.array([0.3]))
    wall, wall_sigma = field.correction(at, np.log([4.0]), np.array([0.3]))
    assert chair[0] > 0.7 * np.log(1.2)
    assert abs(wall[0]) < 0.02
    assert wall_sigma[0] > 0.95 * 0.3 > chair_sigma[0]


def test_outliers_and_unknown_landmarks_are_left_out() -> None:
    px = grid(40)
    truth = plane(px) + 0.1
    truth[::10] += 2.0
    predicted = plane(px)
    predicted[1] = np.nan
    sigma_map = np.full(len(px), 0.01)
    sigma_map[2] = np.nan
    field = fit_depth_field(px, predicted, np.full(len(px), 0.2), truth, sigma_map, width=WIDTH)
    assert field.anchors == len(px) - len(truth[::10]) - 2
    correction, after = field.correction(grid(9), plane(grid(9)), np.full(len(grid(9)), 0.2))
    np.testing.assert_allclose(correction, 0.1, atol=0.02)
    assert np.isfinite(after).all()


def test_many_landmarks_are_thinned() -> None:
    rng = np.random.default_rng(0)
    px = rng.uniform((0, 0), (WIDTH, HEIGHT), (2500, 2))
    field = fit_depth_field(
        px, plane(px), np.full(2500, 0.2), plane(px) + 0.2, rng.uniform(0.01, 0.1, 2500), width=WIDTH
    )
    assert field.anchors == MAX_ANCHORS
    np.testing.assert_allclose(field.mean(px[:9], plane(px[:9]), np.full(9, 0.2)), 0.2, atol=0.03)


@pytest.mark.parametrize("kind", [DepthKind.AFFINE_DEPTH, DepthKind.AFFINE_INVERSE_DEPTH])
def test_relative_depth_is_refused(kind: DepthKind) -> None:
    with pytest.raises(TrackingError, match=f"{kind.value} map cannot be read as metres"):
        log_depth_at(replace(prediction(), kind=kind), np.zeros((1, 2)))


def test_unknown_depth_is_nan() -> None:
    values = np.array([[2.0, 0.0], [np.nan, -1.0], [np.inf, 1e-3]])
    px = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.0, 2.0], [1.0, 2.0]])
    log, sigma = log_depth_at(prediction(values, sigma=None), px)
    np.testing.assert_array_equal(np.isfinite(log), [True, False, False, False, False, True])
    assert log[0] == pytest.approx(np.log(2.0))
    np.testing.assert_array_equal(sigma, DEFAULT_SIGMA_LOG)


def test_log_depth_at_takes_the_nearest_pixel() -> None:
    metric = prediction(np.arange(12.0).reshape(3, 4))
    assert metric.sigma_log is not None
    metric.sigma_log[2, 3] = 0.5
    px = np.array([[1.4, 0.4], [2.6, 1.6], [-0.4, -0.4], [3.4, 2.4]])
    log, sigma = log_depth_at(metric, px)
    np.testing.assert_allclose(np.exp(log), [1, 11, np.nan, 11])
    np.testing.assert_allclose(sigma, [0.2, 0.5, 0.2, 0.5])
    np.testing.assert_array_equal(log_depth_at(prediction(sigma=None), px)[1], DEFAULT_SIGMA_LOG)
    with pytest.raises(TrackingError, match="cannot be read as metres"):
        log_depth_at(replace(metric, kind=DepthKind.AFFINE_DEPTH), px)


def fitted(bias: float = 0.2, sigma: float = 0.2) -> DepthField:
    px = grid(30)
    return fit_depth_field(
        px, plane(px), np.full(len(px), sigma), plane(px) + bias * px[:, 0] / WIDTH,
        np.full(len(px), 0.01), width=WIDTH,
    )  # fmt: skip


def dense_depth(field: DepthField, of: DepthPrediction) -> NDArray[np.float32]:
    return corrected_depth(coarse_correction(field, of), of)


def test_the_corrected_depth_is_the_field_at_every_pixel() -> None:
    field = fitted()
    metric = prediction()
    dense = dense_depth(field, metric)
    assert dense.shape == (HEIGHT, WIDTH)
    assert dense.dtype == np.float32
    u, v = np.meshgrid(np.arange(0, WIDTH, 5), np.arange(0, HEIGHT, 5))
    px = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    log, sigma = prior_log_depth_at(metric, px)
    expected = np.exp(log + field.mean(px, log, sigma))
    inside = (px < [WIDTH - 8, HEIGHT - 8]).all(axis=1)  # constant beyond the last grid point
    np.testing.assert_allclose(dense[v, u].ravel()[inside], expected[inside], rtol=2e-3)
    np.testing.assert_allclose(dense[v, u].ravel(), expected, rtol=0.02)


def test_unknown_depth_stays_unknown_when_corrected() -> None:
    metric = prediction()
    metric.values[50:60, 100:140] = 0.0
    metric.values[0, 0] = np.nan
    dense = dense_depth(fitted(), metric)
    assert (dense[50:60, 100:140] == 0).all()
    assert dense[0, 0] == 0
    assert np.isfinite(dense).all()
    assert (dense > 0).sum() == WIDTH * HEIGHT - 401
    assert (dense_depth(fitted(), prediction(np.zeros((HEIGHT, WIDTH)))) == 0).all()


def test_an_unknown_uncertainty_does_not_affect_neighbours() -> None:
    metric = prediction()
    assert metric.sigma_log is not None
    metric.sigma_log[16, 16] = np.nan
    dense = dense_depth(fitted(), metric)
    assert (dense > 0).sum() >= WIDTH * HEIGHT - 1


def test_the_corrected_depth_without_landmarks_is_the_prior() -> None:
    nothing = np.zeros(0)
    field = fit_depth_field(np.zeros((0, 2)), nothing, nothing, nothing, nothing, width=WIDTH)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    px = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    prior = np.exp(prior_log_depth_at(prediction(), px)[0]).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(dense_depth(field, prediction()), prior, rtol=1e-5)
    sure = prediction(sigma=1e-3)
    np.testing.assert_allclose(dense_depth(field, sure), sure.values, rtol=1e-4)


def test_the_prior_shrinks_uncertain_depth_towards_the_median() -> None:
    px = grid(40)
    middle = np.median(plane(grid(2)))
    sure, sure_sigma = prior_log_depth_at(prediction(sigma=1e-3), px)
    np.testing.assert_allclose(sure, plane(px), atol=1e-3)
    np.testing.assert_allclose(sure_sigma, 1e-3, rtol=1e-3)
    uncertain, uncertain_sigma = prior_log_depth_at(prediction(sigma=0.4), px)
    assert (np.abs(uncertain - middle) <= np.abs(plane(px) - middle) + 0.02).all()
    assert np.std(uncertain) < 0.7 * np.std(plane(px))
    assert (uncertain_sigma < 0.4).all()
    flat, _ = prior_log_depth_at(prediction(sigma=50.0), px)
    np.testing.assert_allclose(flat, middle, atol=0.03)
    holes = prediction()
    holes.values[10, 10] = 0.0
    assert np.isnan(prior_log_depth_at(holes, px)[0]).sum() == (px == 10).all(axis=1).sum()
