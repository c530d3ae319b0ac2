# SPDX-License-Identifier: Apache-2.0
"""The steps of dense depth: rectified images, views, smoothing, agreement, completion."""

from __future__ import annotations

import cv2
import dense_scene as scene
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.dense.agreement import agreement
from slamdepth.dense.completion import spread
from slamdepth.dense.rectify import Rectifier
from slamdepth.dense.semi_global import aggregate, best_label
from slamdepth.dense.sweep import View, matching_cost
from slamdepth.dense.views import choose_views, surface_points
from slamdepth.frontend.rolling_shutter import at_middle_row, row_phase
from slamdepth.types import Camera


def test_pinhole_images_of_the_working_size_are_left_as_they_are() -> None:
    rectifier = Rectifier.of(scene.CAMERA, 160, 0.02)
    assert rectifier.positions(None, 0.5) is None
    image = scene.image(0.0)
    np.testing.assert_array_equal(rectifier.color(image, None), image)


def test_large_images_are_reduced_along_their_longer_side() -> None:
    upright = Rectifier.of(Camera(480, 640, 500, 500, 239.5, 319.5), 320, 0.0)
    assert (upright.camera.width, upright.camera.height) == (240, 320)


def test_lens_distortion_is_removed() -> None:
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5, (-0.2, 0.05, 0.001, -0.001, 0.0))
    positions = Rectifier.of(camera, 160, 0.0).positions(None, 0.5)
    assert positions is not None
    back = camera.undistort_points(positions.reshape(-1, 2))
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    np.testing.assert_allclose(back, np.column_stack([u.ravel(), v.ravel()]), atol=1e-2)


def test_rolling_shutter_is_removed() -> None:
    camera, velocity = scene.CAMERA, np.array([0.3, 0.1, 0.0, 0.1, 0.8, 0.2])
    positions = Rectifier.of(camera, 160, 0.03).positions(velocity, 0.5)
    assert positions is not None
    raw = positions.reshape(-1, 2).astype(np.float64)
    there = at_middle_row(camera, raw, row_phase(raw, camera), np.full(len(raw), 0.5), velocity, 0.03)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    np.testing.assert_allclose(there, np.column_stack([u.ravel(), v.ravel()]), atol=0.02)


def test_views_with_parallax_on_both_sides_are_chosen() -> None:
    points = surface_points(scene.depth_m(0.0), scene.CAMERA, scene.pose(0.0))
    places = np.array([0.0, 0.001, 0.2, 0.21, -0.2, 1.9, 0.1])
    candidates = np.array([scene.pose(x) for x in places])
    candidates[5, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks back
    chosen = choose_views(points, scene.CAMERA, scene.pose(0.0), candidates, 3)
    assert set(places[chosen[:2]]) in ({0.2, -0.2}, {0.21, -0.2})
    assert not {0, 1, 5} & set(chosen.tolist())


def test_no_views_without_candidates() -> None:
    points = surface_points(scene.depth_m(0.0), scene.CAMERA, scene.pose(0.0))
    assert len(choose_views(points, scene.CAMERA, scene.pose(0.0), np.zeros((0, 4, 4)), 3)) == 0


def test_cost_is_least_at_the_true_depth_whatever_the_exposure() -> None:
    ratios = np.linspace(-0.3, 0.3, 13).astype(np.float32)
    bright = np.clip(scene.image(0.2)[..., 0] * 0.6 + 40, 1, 255).astype(np.uint8)
    keyframe = View(scene.image(0.0)[..., 0], scene.pose(0.0))
    views = [View(bright, scene.pose(0.2)), View(scene.image(-0.2)[..., 0], scene.pose(-0.2))]
    cost = matching_cost(keyframe, scene.depth_m(0.0), views, scene.CAMERA, ratios)
    inner = cost[:, 20:-20, 40:-40]
    assert (inner.argmin(axis=0) == 6).mean() > 0.95
    assert inner.min() >= 0.0
    assert inner.max() <= 1.2


def test_pixels_that_no_view_sees_have_the_same_cost_everywhere() -> None:
    ratios = np.linspace(-0.3, 0.3, 5).astype(np.float32)
    away = scene.pose(0.2)
    away[:3, :3] = cv2.Rodrigues(np.array([0.0, 1.5, 0.0]))[0]
    keyframe = View(scene.image(0.0)[..., 0], scene.pose(0.0))
    views = [View(scene.image(0.2)[..., 0], away)] * 2
    cost = matching_cost(keyframe, scene.depth_m(0.0), views, scene.CAMERA, ratios)
    np.testing.assert_array_equal(cost, 1.0)


def test_smoothing_fills_what_tells_nothing_and_keeps_a_step_at_an_edge() -> None:
    grey = np.full((30, 40), 60, np.uint8)
    grey[:, 20:] = 200
    cost = np.ones((9, 30, 40), np.float32)
    cost[2, :, :20], cost[6, :, 20:] = 0.2, 0.2
    cost[:, 10:20, 5:15] = 1.0  # no texture
    label, position = best_label(aggregate(cost, grey))
    assert (label[:, :20] == 2).all()
    assert (label[:, 20:] == 6).all()
    np.testing.assert_allclose(position, label, atol=0.5)


def test_label_is_refined_by_a_parabola() -> None:
    at = np.arange(9, dtype=np.float32)
    total = ((at - 4.3) ** 2)[None, None].repeat(3, 0)
    label, position = best_label(total)
    assert (label == 4).all()
    np.testing.assert_allclose(position, 4.3, atol=1e-5)


def test_true_depths_agree_and_wrong_ones_do_not() -> None:
    others = [(scene.depth_m(x), scene.pose(x)) for x in (0.1, 0.2, -0.1)]
    true = agreement(scene.depth_m(0.0), scene.pose(0.0), others, scene.CAMERA)
    inner = np.s_[20:-20, 30:-30]
    assert (true.agree[inner] == 3).all()
    assert true.is_confirmed[inner].all()
    np.testing.assert_allclose(true.mean_log[inner], 0.0, atol=6e-3)
    wrong = agreement(scene.depth_m(0.0) * 1.1, scene.pose(0.0), others, scene.CAMERA)
    assert not wrong.is_confirmed.any()
    assert (wrong.seen[inner] == 3).all()


def test_known_values_spread_up_to_edges() -> None:
    grey = np.full((96, 128), 50, np.uint8)
    grey[:, 64:] = 220
    values, weight = np.zeros((2, 96, 128), np.float32)
    values[40:50, 10:20], weight[40:50, 10:20] = 0.3, 10.0
    values[40:50, 100:110], weight[40:50, 100:110] = -0.2, 10.0
    x = spread(values, weight, grey, 60.0)
    np.testing.assert_allclose(x[40:50, 10:20], 0.3, atol=0.02)
    assert x[45, 60] > 0.15
    assert x[45, 68] < -0.1


def test_nothing_known_is_zero() -> None:
    none = np.zeros((50, 60), np.float32)
    np.testing.assert_array_equal(spread(none, none, np.zeros((50, 60), np.uint8), 60.0), 0.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(8, 90), st.integers(8, 90), st.integers(0, 2**31 - 1))
def test_spread_values_stay_within_those_that_are_known(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.uniform(-0.4, 0.4, (height, width)).astype(np.float32)
    weight = np.where(rng.uniform(size=values.shape) < 0.2, 4.0, 0.0).astype(np.float32)
    grey = rng.integers(1, 256, values.shape, dtype=np.uint8)
    x = spread(values, weight, grey, 60.0)
    assert np.isfinite(x).all()
    assert np.abs(x).max() <= 0.4 + 0.05
