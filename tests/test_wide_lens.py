# SPDX-License-Identifier: Apache-2.0
"""Models of wide lenses: inverse of each other, and equal to what others compute."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wide_world import LENSES

from slamdepth.calibration import WIDE_MODELS, WideLens
from slamdepth.errors import CameraError
from slamdepth.types import Camera
from slamdepth.typing import Floats

RELAXED = settings(deadline=None, max_examples=150)
small, tangential, share = st.floats(-0.05, 0.05), st.floats(-0.002, 0.002), st.floats(0.0, 0.9)
lenses = st.one_of(
    st.tuples(small, small, small, small).map(lambda c: WideLens("fisheye", c)),
    st.tuples(st.floats(-0.6, 0.9), share).map(lambda c: WideLens("double_sphere", c)),
    st.tuples(share, st.floats(0.5, 1.5)).map(lambda c: WideLens("extended_unified", c)),
    st.tuples(
        st.floats(0.0, 2.0), small, small, small.map(lambda v: v / 10), small.map(lambda v: v / 10)
    ).map(lambda c: WideLens("unified", c)),
    st.floats(0.1, 2.5).map(lambda w: WideLens("fov", (w,))),
)


def rays_within(theta_rad: float, count: int = 400) -> Floats:
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0.0, theta_rad, count), rng.uniform(0.0, 2.0 * np.pi, count)
    theta[0] = 0.0
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


@RELAXED
@given(lenses)
def test_a_ray_that_is_seen_comes_back(lens: WideLens) -> None:
    rays = rays_within(0.98 * min(lens.widest_rad, 2.0))
    plane = lens.project(7.0 * rays)
    np.testing.assert_allclose(plane[0], 0.0, atol=1e-12)
    back = lens.unproject(plane)
    is_known = np.isfinite(back).all(axis=1)
    assert is_known.mean() > 0.97  # tangential distortion turns back a little sooner than the radial one
    np.testing.assert_allclose(back[is_known], rays[is_known], atol=1e-6)


@RELAXED
@given(lenses, st.floats(1.01, 1.5))
def test_what_lies_beyond_the_lens_is_not_seen(lens: WideLens, beyond: float) -> None:
    theta = beyond * lens.widest_rad
    if theta < math.pi:
        assert np.isnan(lens.project(np.array([[math.sin(theta), 0.0, math.cos(theta)]]))).all()


@given(st.tuples(small, small, small, small))
def test_fisheye_is_that_of_opencv(coefficients: tuple[float, float, float, float]) -> None:
    lens = WideLens("fisheye", coefficients)
    rays = rays_within(min(1.5, lens.widest_rad))
    found, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients)
    )
    np.testing.assert_allclose(lens.project(rays), found[:, 0], atol=1e-12)


def test_unified_is_that_of_mei() -> None:
    """The formulas of OpenCV's omnidir module, which the headless build leaves out."""
    xi, k1, k2, p1, p2 = LENSES["unified"].coefficients
    rays = rays_within(1.4)
    x, y = (rays[:, :2] / (rays[:, 2:] + xi)).T
    r2 = x * x + y * y
    expected, _ = cv2.projectPoints(
        np.column_stack([x, y, np.ones(len(x))]),
        np.zeros(3),
        np.zeros(3),
        np.eye(3),
        np.array([k1, k2, p1, p2]),
    )
    assert (r2 > 0.1).any()
    np.testing.assert_allclose(LENSES["unified"].project(rays), expected[:, 0], atol=1e-12)


def test_double_sphere_and_extended_unified_are_those_of_their_papers() -> None:
    rays = rays_within(1.7)
    x, y, z = rays.T
    xi, alpha = LENSES["double_sphere"].coefficients
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    bottom = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    np.testing.assert_allclose(
        LENSES["double_sphere"].project(rays), rays[:, :2] / bottom[:, None], atol=1e-12
    )
    alpha, beta = LENSES["extended_unified"].coefficients
    bottom = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    np.testing.assert_allclose(
        LENSES["extended_unified"].project(rays), rays[:, :2] / bottom[:, None], atol=1e-12
    )


def test_the_models_agree_where_they_are_the_same() -> None:
    """Double sphere without shift is the unified model; both with ``alpha`` 0 are a pinhole."""
    rays = rays_within(1.2)
    one, other = WideLens("double_sphere", (0.0, 0.4)), WideLens("extended_unified", (0.4, 1.0))
    np.testing.assert_allclose(one.project(rays), other.project(rays), atol=1e-12)
    unified = WideLens("unified", (0.4 / 0.6, 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(one.project(rays), unified.project(rays) / 0.6, atol=1e-12)
    pinhole = WideLens("double_sphere", (0.0, 0.0)).project(rays)
    np.testing.assert_allclose(pinhole, rays[:, :2] / rays[:, 2:], atol=1e-12)


@pytest.mark.parametrize(
    ("model", "coefficients", "problem"),
    [
        ("wide", (0.1,), "unknown lens model 'wide'; known: fisheye, double_sphere"),
        ("fisheye", (0.1, 0.2), r"needs 4 numbers \[k1, k2, k3, k4\]"),
        ("fov", (float("nan"),), "must be finite"),
        ("fisheye", (-900.0, 0.0, 0.0, 0.0), "sees nothing: check the order"),
        ("double_sphere", (-3.0, 0.5), "sees nothing"),
    ],
)
def test_impossible_lenses_are_refused(model: str, coefficients: tuple[float, ...], problem: str) -> None:
    with pytest.raises(CameraError, match=problem):
        WideLens(model, coefficients)


@RELAXED
@given(st.sampled_from(list(WIDE_MODELS)), st.lists(st.floats(-1e3, 1e3), min_size=5, max_size=5))
def test_any_numbers_make_a_sound_lens_or_are_refused(model: str, numbers: list[float]) -> None:
    try:
        lens = WideLens(model, tuple(numbers[: len(WIDE_MODELS[model])]))
    except CameraError:
        return
    rays = lens.unproject(np.random.default_rng(2).normal(size=(50, 2)))
    is_known = np.isfinite(rays).all(axis=1)
    np.testing.assert_allclose(np.linalg.norm(rays[is_known], axis=1), 1.0, atol=1e-9)


def test_a_camera_with_a_wide_lens_is_used_as_a_pinhole_nowhere() -> None:
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, lens=LENSES["fisheye"])
    for use in (
        lambda: camera.K,
        lambda: camera.distortion_array,
        camera.without_distortion,
        lambda: camera.undistort_points(np.zeros((1, 2))),
    ):
        with pytest.raises(CameraError, match="'fisheye' is no pinhole: undistort its images"):
            use()
    with pytest.raises(CameraError, match="no distortion besides"):
        Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (0.1, 0.0, 0.0, 0.0, 0.0), lens=LENSES["fisheye"])


def test_mirrored_and_scaled_cameras_keep_their_lens() -> None:
    camera = Camera(640, 480, 300.0, 300.0, 311.0, 240.0, lens=LENSES["unified"])
    rays = rays_within(1.0)
    at = seen_at(camera, rays)
    mirrored = camera.mirrored()
    np.testing.assert_allclose(
        seen_at(mirrored, rays * [-1.0, 1.0, 1.0]), [639.0, 0.0] + at * [-1.0, 1.0], atol=1e-9
    )
    half = camera.scaled(320, 240)
    np.testing.assert_allclose(seen_at(half, rays), (at + 0.5) / 2.0 - 0.5, atol=1e-9)


def seen_at(camera: Camera, rays: Floats) -> Floats:
    assert camera.lens is not None
    return camera.lens.project(rays) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
