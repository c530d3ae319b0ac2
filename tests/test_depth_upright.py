# SPDX-License-Identifier: Apache-2.0
"""Images rotated upright, and predictions for them rotated back."""

from __future__ import annotations

import numpy as np
import pytest

from slamdepth.depth.upright import roll_rad, rotated, rotated_back
from slamdepth.types import Camera, DepthKind, DepthPrediction

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def prediction(values: np.ndarray, sigma: float | None = None) -> DepthPrediction:
    values = values.astype(np.float32)
    return DepthPrediction(values, DepthKind.METRIC, None if sigma is None else np.full_like(values, sigma))


def test_roll_is_positive_where_gravity_points_to_the_right() -> None:
    assert roll_rad(np.array([0.5, 0.5, 0.7])) == pytest.approx(np.pi / 4)
    assert roll_rad(np.array([0.0, 1.0, 0.0])) == 0.0


def test_after_a_rotation_by_minus_the_roll_gravity_points_down_the_image() -> None:
    image = np.zeros((120, 160, 3), np.uint8)
    roll = 0.5
    u, v = 79.5 + 40 * np.sin(roll), 59.5 + 40 * np.cos(roll)
    image[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    row, column = np.argwhere(rotated(image, CAMERA, -roll)[..., 0] > 128).mean(axis=0)
    assert (row, column) == (pytest.approx(99.5, abs=1), pytest.approx(79.5, abs=1))


@pytest.mark.parametrize("roll", [0.3, -1.2])
def test_a_plane_predicted_upright_comes_out_as_the_plane_as_taken(roll: float) -> None:
    v, u = np.mgrid[:120, :160]
    depth = 2.0 + 0.005 * u + 0.008 * v
    M_upright = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    x, y = u - 79.5, v - 59.5
    upright = 2.0 + 0.005 * (M_upright[0, 0] * x + M_upright[0, 1] * y + 79.5)
    upright = upright + 0.008 * (M_upright[1, 0] * x + M_upright[1, 1] * y + 59.5)
    back = rotated_back(prediction(upright), prediction(depth), CAMERA, roll).values
    np.testing.assert_allclose(back, depth, atol=0.02)  # a pixel is 0.005 to 0.008


def test_corners_that_were_cut_off_take_the_other_prediction_at_the_upright_scale() -> None:
    as_taken = prediction(np.full((120, 160), 4.0), 0.3)
    back = rotated_back(prediction(np.full((120, 160), 2.0), 0.1), as_taken, CAMERA, 0.6)
    np.testing.assert_allclose(back.values, 2.0)
    assert back.sigma_log is not None
    assert back.sigma_log[60, 80] == np.float32(0.1)
    assert back.sigma_log[0, 0] == np.float32(0.3)


def test_a_rotation_by_zero_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    np.testing.assert_array_equal(rotated(image, CAMERA, 0.0), image)
    depth = prediction(image[..., 0].astype(np.float32) + 1.0)
    back = rotated_back(depth, prediction(np.ones((120, 160))), CAMERA, 0.0)
    np.testing.assert_array_equal(back.values, depth.values)
    assert back.sigma_log is None


def test_there_is_no_step_where_the_rotated_image_was_cut_off() -> None:
    """The two predictions differ by a factor that grows to the right; the result keeps it to the corners."""
    u = np.arange(160) / 160
    as_taken = np.full((120, 160), 2.0)
    upright = as_taken * np.exp(0.3 + 0.2 * u)[None]
    roll = 0.4
    back = rotated_back(prediction(upright), prediction(as_taken), CAMERA, roll).values
    steps = np.maximum(
        np.abs(np.diff(np.log(back), axis=0))[:, 1:], np.abs(np.diff(np.log(back), axis=1))[1:]
    )
    assert steps.max() < 0.02
    assert back[5, 5] == pytest.approx(2.0 * np.exp(0.3), rel=0.08)
    assert back[5, 154] == pytest.approx(2.0 * np.exp(0.5), rel=0.08)


def test_a_share_of_one_half_gives_the_geometric_mean() -> None:
    two, eight = np.full((120, 160), 2.0), np.full((120, 160), 8.0)
    back = rotated_back(prediction(eight, 0.2), prediction(two, 0.4), CAMERA, 0.1, 0.5)
    np.testing.assert_allclose(back.values, 4.0, rtol=1e-6)
    assert back.sigma_log is not None
    assert back.sigma_log[60, 80] == pytest.approx(0.3)
