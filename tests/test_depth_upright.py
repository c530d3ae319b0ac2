# SPDX-License-Identifier: Apache-2.0
"""Images rotated upright, and predictions for them rotated back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamdepth.depth.upright import UprightView, roll_rad
from slamdepth.types import Camera, DepthKind, DepthPrediction

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def prediction(values: np.ndarray, sigma: float | None = None) -> DepthPrediction:
    values = values.astype(np.float32)
    return DepthPrediction(values, DepthKind.METRIC, None if sigma is None else np.full_like(values, sigma))


def plane_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth by pixels from the centre of the image as taken."""
    return 2.0 + 0.005 * x + 0.008 * y


def upright_plane(view: UprightView) -> np.ndarray:
    """The same plane in the view: upright pixels are those as taken, turned by minus the roll."""
    rows, columns = view.size
    v, u = np.mgrid[:rows, :columns]
    x, y, roll = u - (columns - 1) / 2, v - (rows - 1) / 2, view.roll_rad
    return plane_m(np.cos(roll) * x + np.sin(roll) * y, -np.sin(roll) * x + np.cos(roll) * y)


def test_roll_is_positive_where_gravity_points_to_the_right() -> None:
    assert roll_rad(np.array([0.5, 0.5, 0.7])) == pytest.approx(np.pi / 4)
    assert roll_rad(np.array([0.0, 1.0, 0.0])) == 0.0


@pytest.mark.parametrize("roll", [0.5, -0.5, 1.5, 3.0])
def test_gravity_points_down_the_view(roll: float) -> None:
    image = np.zeros((120, 160, 3), np.uint8)
    u, v = 79.5 + 40 * np.sin(roll), 59.5 + 40 * np.cos(roll)
    image[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    view = UprightView(CAMERA, roll)
    row, column = np.argwhere(view.rotated(image)[..., 0] > 128).mean(axis=0)
    middle = (view.size[0] - 1) / 2, (view.size[1] - 1) / 2
    assert (row, column) == (pytest.approx(middle[0] + 40, abs=1), pytest.approx(middle[1], abs=1))


@given(st.floats(-np.pi, np.pi))
def test_a_view_has_the_area_of_the_image(roll: float) -> None:
    rows, columns = UprightView(CAMERA, roll).size
    assert rows * columns == pytest.approx(160 * 120, rel=0.02)


def test_a_quarter_turn_shows_all_of_the_image() -> None:
    view = UprightView(CAMERA, np.pi / 2)
    assert view.size == (160, 120)
    depth_m = np.random.default_rng(0).uniform(1.0, 2.0, view.size)
    back = view.rotated_back(prediction(depth_m, 0.1))
    np.testing.assert_array_equal(np.sort(back.values, axis=None), np.sort(depth_m.astype("f4"), axis=None))
    assert back.sigma_log is not None
    assert (back.sigma_log == np.float32(0.1)).all()


@pytest.mark.parametrize("roll", [0.3, -1.2, 2.0])
def test_a_plane_predicted_upright_comes_out_as_the_plane_as_taken(roll: float) -> None:
    view = UprightView(CAMERA, roll)
    back = view.rotated_back(prediction(upright_plane(view), 0.1))
    assert back.values.shape == (120, 160)
    assert back.sigma_log is not None
    is_seen = back.sigma_log < 0.11
    assert 0.7 < is_seen.mean() < 1.0
    v, u = np.mgrid[:120, :160]
    as_taken = plane_m(u - 79.5, v - 59.5)
    np.testing.assert_allclose(
        back.values[is_seen], as_taken[is_seen], atol=0.02
    )  # a pixel is 0.005 to 0.008
    np.testing.assert_allclose(back.values, as_taken, atol=0.4)


def test_corners_out_of_view_are_less_certain_the_farther_out_they_are() -> None:
    sigma = UprightView(CAMERA, 0.6).rotated_back(prediction(np.full((120, 160), 2.0), 0.1)).sigma_log
    assert sigma is not None
    assert sigma[60, 80] == np.float32(0.1)
    diagonal = sigma[np.arange(20), np.arange(20)]
    assert (np.diff(diagonal) <= 0).all()
    assert diagonal[0] > diagonal[10] > np.hypot(0.1, 0.15)


def test_without_a_deviation_there_is_none_after_it() -> None:
    assert UprightView(CAMERA, 0.6).rotated_back(prediction(np.ones((126, 152)))).sigma_log is None
