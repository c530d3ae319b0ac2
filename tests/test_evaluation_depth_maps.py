# SPDX-License-Identifier: Apache-2.0
"""SSIM, edges, fits and intervals on cases whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.evaluation.bootstrap import block_length, interval, spread
from slamdepth.evaluation.depth_fit import affine_fit, apply_affine
from slamdepth.evaluation.depth_maps import depth_ssim, edge_score
from slamdepth.evaluation.depth_pixels import as_depth
from slamdepth.types import DepthKind

ALL = np.ones((20, 64), dtype=bool)


def step(column: int, near: float = 1.0, far: float = 2.0, width: int = 64) -> np.ndarray:
    """A wall with a step at ``column``, which is the first far one."""
    depth = np.full((20, width), near, np.float32)
    depth[:, column:] = far
    return depth


def test_ssim_of_equal_and_of_flat_maps() -> None:
    assert depth_ssim(step(30), step(30), ALL) == pytest.approx(1.0, abs=1e-12)
    one, two = np.full((20, 64), 1.0), np.full((20, 64), 2.0)
    c1 = (0.01 * 2.0) ** 2  # the data range is the sensor's largest depth
    assert depth_ssim(one, two, ALL) == pytest.approx((2 * 1 * 2 + c1) / (1 + 4 + c1), rel=1e-9)


def test_ssim_as_its_definition_says_window_by_window() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(1, 3, (2, 16, 18))
    known = rng.random((16, 18)) > 0.3
    offsets = np.arange(-5, 6)
    kernel = np.exp(-(offsets**2) / (2 * 1.5**2))
    c1, c2 = (0.01 * y[known].max()) ** 2, (0.03 * y[known].max()) ** 2
    values = []
    for row, column in zip(*np.nonzero(known), strict=True):
        weights, xs, ys = [], [], []
        for i, wi in zip(offsets, kernel, strict=True):
            for j, wj in zip(offsets, kernel, strict=True):
                r, c = row + i, column + j
                if 0 <= r < 16 and 0 <= c < 18 and known[r, c]:
                    weights.append(wi * wj)
                    xs.append(x[r, c])
                    ys.append(y[r, c])
        w = np.array(weights) / np.sum(weights)
        mx, my = w @ xs, w @ ys
        vx, vy, cov = w @ (xs - mx) ** 2, w @ (ys - my) ** 2, w @ ((xs - mx) * (ys - my))
        values.append((2 * mx * my + c1) / (mx**2 + my**2 + c1) * (2 * cov + c2) / (vx + vy + c2))
    assert depth_ssim(x, y, known) == pytest.approx(np.mean(values), rel=1e-6)


def test_ssim_does_not_see_unknown_pixels() -> None:
    known = np.random.default_rng(1).random((20, 64)) > 0.4
    spoilt = np.where(known, step(30), 100.0)
    assert depth_ssim(spoilt, step(30), known) == pytest.approx(1.0, abs=1e-12)


def test_edges_of_a_perfect_map_in_any_unit() -> None:
    for factor in (1.0, 0.01, 300.0):
        score = edge_score(step(30) * factor, step(30), ALL)
        assert score is not None
        assert (score.f1, score.error_px) == (1.0, 0.0)


def test_a_shifted_edge_is_off_by_its_shift() -> None:
    """Pixels count as of an image 640 wide: here ten for one."""
    wide = np.ones((20, 640), dtype=bool)
    score = edge_score(step(303, width=640), step(300, width=640), wide)
    assert score is not None
    assert score.f1 == 0.0
    assert score.error_px == pytest.approx(3.0)
    far_off = edge_score(step(500, width=640), step(300, width=640), wide)
    assert far_off is not None
    assert far_off.error_px == 10.0


def test_a_flat_map_misses_every_edge_and_a_reversed_step_is_none() -> None:
    flat = edge_score(np.ones((20, 64)), step(30), ALL)
    assert flat is not None
    assert (flat.f1, flat.error_px) == (0.0, 10.0)
    reverse = edge_score(step(30, near=2.0, far=1.0), step(30), ALL)
    assert reverse is not None
    assert reverse.f1 == 0.0


def test_half_of_the_edges_by_hand() -> None:
    """Two steps at the sensor, one of them predicted: precision 1, recall 1/2, F 2/3."""
    sensor = step(20)
    sensor[:, 40:] = 4.0
    score = edge_score(step(20), sensor, ALL)
    assert score is not None
    assert score.f1 == pytest.approx(2 / 3)
    # from the sensor's edges 0 and 10, from the predicted 0
    assert score.error_px == pytest.approx((5.0 + 0.0) / 2)


def test_a_small_step_counts_at_small_ratios_only() -> None:
    """A step by 10 % is an edge at 1.05 to 1.0944; a prediction of 7 % finds it at 1.05 alone."""
    score = edge_score(step(30, far=1.06), step(30, far=1.099), ALL)
    assert score is not None
    ratios = np.linspace(1.05, 1.25, 10)[:3]
    assert score.f1 == pytest.approx(ratios[0] / ratios.sum())
    assert math.isnan(score.error_px)  # none of 1.10 to locate


def test_no_edge_is_no_score() -> None:
    assert edge_score(step(30), np.ones((20, 64)), ALL) is None


def test_a_hole_at_the_edge_does_not_hide_it() -> None:
    """640 wide images may have gaps of 20 pixels, 64 wide ones of 2: the next known one is 2 on."""
    known = ALL.copy()
    known[:, 30] = False
    score = edge_score(step(30), step(30), known)
    assert score is not None
    assert (score.f1, score.error_px) == (1.0, 0.0)
    known[:, 31] = False
    assert edge_score(step(30), step(30), known) is None


def test_edges_along_columns_too() -> None:
    tall = np.vstack([np.ones((10, 64)), np.full((10, 64), 2.0)])
    score = edge_score(tall, tall, ALL)
    assert score is not None
    assert score.f1 == 1.0
    assert edge_score(np.ones((20, 64)), tall, ALL) is not None


def test_values_become_depth_by_their_kind() -> None:
    values = np.array([2.0, 0.0, -1.0, np.nan, np.inf, 0.5])
    np.testing.assert_array_equal(as_depth(values, DepthKind.METRIC), [2, 0, 0, 0, 0, 0.5])
    np.testing.assert_array_equal(as_depth(values, DepthKind.AFFINE_INVERSE_DEPTH), [0.5, 0, 0, 0, 0, 2])


@settings(max_examples=50, deadline=None)
@given(
    factor=st.floats(0.1, 10),
    shift=st.floats(-0.05, 0.5),
    kind=st.sampled_from([DepthKind.AFFINE_DEPTH, DepthKind.AFFINE_INVERSE_DEPTH]),
    seed=st.integers(0, 1000),
)
def test_an_affine_prediction_is_undone(factor: float, shift: float, kind: DepthKind, seed: int) -> None:
    sensor = np.random.default_rng(seed).uniform(0.5, 5, 200)
    linear = 1 / sensor if kind is DepthKind.AFFINE_INVERSE_DEPTH else sensor
    depth = as_depth(factor * (linear + shift), kind)
    fit = affine_fit(depth, sensor, kind)
    assert fit == pytest.approx((1 / factor, -shift), rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(apply_affine(depth, fit, kind, 0.1, 10.0), sensor, rtol=1e-6)


def test_a_flat_prediction_fits_as_the_mean_and_nothing_leaves_the_range() -> None:
    sensor = np.array([1.0, 3.0])
    assert affine_fit(np.array([2.0, 2.0]), sensor, DepthKind.METRIC) == (0.0, 2.0)
    clipped = apply_affine(np.array([1.0, 5.0, 0.0]), (10.0, -20.0), DepthKind.METRIC, 0.1, 10.0)
    np.testing.assert_array_equal(clipped, [0.1, 10.0, 0.0])
    inverse = apply_affine(np.array([1.0]), (1.0, -2.0), DepthKind.AFFINE_INVERSE_DEPTH, 0.1, 10.0)
    assert inverse[0] == pytest.approx(10.0)


def test_intervals() -> None:
    assert interval(np.full(20, 3.0)) == interval(np.full(20, 3.0), block=1)
    flat = interval(np.full(20, 3.0))
    assert (flat.value, flat.low, flat.high) == (3.0, 3.0, 3.0)
    few = interval(np.arange(7.0))
    assert (few.value, few.low, few.high) == (3.0, None, None)
    assert math.isnan(interval(np.array([np.nan])).value)
    gappy = interval(np.array([1.0, np.nan] * 10))
    assert (gappy.value, gappy.high) == (1.0, 1.0)


def test_an_interval_of_independent_frames_is_the_textbook_one() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    found = interval(values, block=1)
    assert found.low is not None
    assert found.high is not None
    half = 1.96 * values.std() / math.sqrt(400)
    assert found.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert found.high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_alike_neighbours_widen_the_interval() -> None:
    """Each of 36 values repeated 36 times: blocks of 36 know that there are no 1,296 frames."""
    values = np.repeat(np.random.default_rng(1).normal(size=36), 36)
    assert block_length(len(values)) == 36
    blocks, single = interval(values), interval(values, block=1)
    widths = [(i.high or 0) - (i.low or 0) for i in (blocks, single)]
    assert widths[0] > 4 * widths[1]


def test_the_spread_is_a_statistic_of_frames() -> None:
    values = np.tile([0.0, 2.0], 20)
    found = interval(values, spread)
    assert found.value == 1.0
    assert found.low is not None
    assert 0.9 < found.low <= 1.0
