# SPDX-License-Identifier: Apache-2.0
"""Depth scores: exact cases and properties of the three ways of scaling."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.evaluation import DepthJudge, DepthScorer
from slamdepth.evaluation.depth import depth_errors
from slamdepth.types import DepthKind, DepthPrediction


def room(seed: int = 0, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 5.0, size=shape).astype(np.float32)


def test_errors_by_hand() -> None:
    errors = depth_errors(np.array([1.0, 3.0, 2.0], np.float32), np.array([1.0, 2.0, 4.0], np.float32))
    assert errors.abs_rel == pytest.approx((0 + 0.5 + 0.5) / 3)
    assert errors.rmse_m == pytest.approx(np.sqrt((0 + 1 + 4) / 3))
    assert errors.log_rmse == pytest.approx(np.sqrt((np.log(1.5) ** 2 + np.log(2) ** 2) / 3))
    assert errors.delta1 == pytest.approx(1 / 3)
    assert errors.delta2 == pytest.approx(2 / 3)
    assert errors.delta3 == pytest.approx(2 / 3)


def test_a_perfect_prediction_has_no_error() -> None:
    scorer = DepthScorer(stride=1)
    assert scorer.add(room(), room())
    score = scorer.score()
    assert score is not None
    for errors in (score.metric, score.sequence_median, score.frame_median):
        assert errors.abs_rel == errors.rmse_m == errors.log_rmse == 0
        assert errors.delta1 == errors.delta2 == errors.delta3 == 1
    assert (score.frames, score.pixels, score.coverage) == (1, 24 * 32, 1.0)
    assert (score.sequence_scale, score.frame_scale_spread) == (1.0, 0.0)


def test_each_way_of_scaling_removes_its_own_error() -> None:
    """One factor for all frames is what the sequence median removes, one a frame the frame median."""
    constant, wobbling = DepthScorer(stride=1), DepthScorer(stride=1)
    for index, factor in enumerate((0.5, 1.0, 2.0)):
        constant.add(room(index) / 2, room(index))
        wobbling.add(room(index) / factor, room(index))
    score = constant.score()
    assert score is not None
    assert score.metric.abs_rel == pytest.approx(0.5)
    assert score.metric.delta1 == 0
    assert score.sequence_scale == pytest.approx(2.0)
    assert score.sequence_median.abs_rel == pytest.approx(0.0, abs=1e-6)
    score = wobbling.score()
    assert score is not None
    assert score.sequence_scale == pytest.approx(1.0)
    assert score.sequence_median.abs_rel == pytest.approx((1.0 + 0.0 + 0.5) / 3, rel=1e-5)
    assert score.frame_median.abs_rel == pytest.approx(0.0, abs=1e-6)
    assert score.frame_scale_spread == pytest.approx(np.log(2) * np.sqrt(2 / 3), rel=1e-6)


def test_only_valid_sensor_pixels_count_and_missing_predictions_lower_the_coverage() -> None:
    sensor = np.full((10, 10), 2.0, dtype=np.float32)
    sensor[:5] = [0.0, 0.05, 11.0, np.nan, np.inf] * 2
    predicted = np.full((10, 10), 2.0, dtype=np.float32)
    predicted[9] = [0.0, -1.0, np.nan, np.inf, 2.0] * 2
    scorer = DepthScorer(stride=1)
    scorer.add(predicted, sensor)
    score = scorer.score()
    assert score is not None
    assert score.pixels == 42
    assert score.coverage == pytest.approx(42 / 50)
    assert score.metric.abs_rel == 0


def test_nothing_to_compare_is_no_score() -> None:
    scorer = DepthScorer()
    assert scorer.score() is None
    assert not scorer.add(np.zeros((8, 8), np.float32), np.ones((8, 8), np.float32))
    assert not scorer.add(np.ones((8, 8), np.float32), np.zeros((8, 8), np.float32))
    assert (scorer.score(), scorer.frames) == (None, 0)


def test_frames_without_common_pixels_still_lower_the_coverage() -> None:
    scorer = DepthScorer(stride=1)
    scorer.add(room(), room())
    scorer.add(np.zeros_like(room()), room())
    score = scorer.score()
    assert score is not None
    assert (score.frames, score.coverage) == (1, 0.5)


def test_frames_weigh_the_same_however_much_the_sensor_saw() -> None:
    scorer = DepthScorer(stride=1)
    full = np.full((10, 10), 2.0, dtype=np.float32)
    sparse = np.zeros_like(full)
    sparse[0, 0] = 2.0
    scorer.add(full, full)
    scorer.add(full * 1.2, sparse)
    score = scorer.score()
    assert score is not None
    assert score.metric.abs_rel == pytest.approx(0.1, rel=1e-5)


def test_memory_is_bounded_and_the_sequence_score_hardly_moves() -> None:
    rng = np.random.default_rng(3)
    small = DepthScorer(stride=1, max_samples=4000)
    large = DepthScorer(stride=1)
    for index in range(60):
        predicted = room(index) * np.exp(rng.normal(0.1, 0.1, size=(24, 32))).astype(np.float32)
        for scorer in (small, large):
            scorer.add(predicted, room(index))
        assert sum(len(p) for p, _ in small._samples) <= 4000
    thinned, full = small.score(), large.score()
    assert thinned is not None
    assert full is not None
    assert (thinned.metric, thinned.frame_median) == (full.metric, full.frame_median)
    assert thinned.sequence_scale == pytest.approx(full.sequence_scale, rel=0.01)
    assert thinned.sequence_median.abs_rel == pytest.approx(full.sequence_median.abs_rel, rel=0.05)


def test_a_bound_below_one_sample_a_frame_keeps_one_of_each() -> None:
    scorer = DepthScorer(stride=1, max_samples=2)
    for index in range(5):
        scorer.add(room(index), room(index))
    assert [len(p) for p, _ in scorer._samples] == [1] * 5


def test_stride_takes_every_nth_pixel_both_ways() -> None:
    scorer = DepthScorer(stride=4)
    scorer.add(room(), room())
    score = scorer.score()
    assert score is not None
    assert score.pixels == 24 * 32 // 16


def test_a_report_and_eval_depth_say_the_same_of_the_same_maps() -> None:
    rng = np.random.default_rng(7)
    scorer, judge = DepthScorer(), DepthJudge(DepthKind.METRIC)
    for index in range(9):
        sensor = room(index, (48, 64)) * (rng.random((48, 64)) > 0.2) * 3  # some of it unknown or too far
        predicted = room(index, (48, 64)) * 3 * np.exp(rng.normal(0.1, 0.2, (48, 64)))
        predicted[rng.random((48, 64)) < 0.1] = 0
        scorer.add(predicted, sensor)
        judge.add(DepthPrediction(predicted.astype(np.float32), DepthKind.METRIC), sensor)
    score, judged = scorer.score(), judge.judge()
    assert score is not None
    assert judged is not None
    ways = {"as_predicted": score.metric} | {
        way: getattr(score, way) for way in ("sequence_median", "frame_median")
    }
    for way, errors in ways.items():
        for name, figure in asdict(errors).items():
            assert judged.ways[way][name].value == pytest.approx(figure, rel=1e-5)
    assert judged.sequence_factor == pytest.approx(score.sequence_scale, rel=1e-6)
    assert judged.scale_spread.value == pytest.approx(score.frame_scale_spread, rel=1e-5)
    assert (judged.frames, judged.pixels, judged.coverage) == (score.frames, score.pixels, score.coverage)
    assert 0.8 < score.coverage < 1


def test_score_is_json() -> None:
    scorer = DepthScorer()
    scorer.add(room(1), room(2))
    score = scorer.score()
    assert score is not None
    figures = json.loads(json.dumps(score.to_dict()))
    for way in ("metric", "sequence_median", "frame_median"):
        assert {"abs_rel", "rmse_m", "delta1"} <= set(figures[way])


def test_wrong_use_is_an_error() -> None:
    with pytest.raises(ValueError, match="share one"):
        DepthScorer().add(np.ones((4, 4), np.float32), np.ones((4, 5), np.float32))
    with pytest.raises(ValueError, match="min_m"):
        DepthScorer(min_m=2.0, max_m=1.0)
    with pytest.raises(ValueError, match="stride"):
        DepthScorer(stride=0)


@settings(max_examples=50, deadline=None)
@given(factor=st.floats(0.1, 10.0), seed=st.integers(0, 1000))
def test_scaled_figures_do_not_depend_on_the_unit_of_the_prediction(factor: float, seed: int) -> None:
    scores = []
    for scale in (1.0, factor):
        scorer = DepthScorer(stride=1)
        for index in range(3):
            scorer.add(room(seed + index) * np.float32(scale), room(seed + index + 10_000))
        scores.append(scorer.score())
    assert scores[0] is not None
    assert scores[1] is not None
    for way in ("sequence_median", "frame_median"):
        one, other = getattr(scores[0], way), getattr(scores[1], way)
        assert one.abs_rel == pytest.approx(other.abs_rel, rel=1e-4)
        assert one.rmse_m == pytest.approx(other.rmse_m, rel=1e-4)
    assert scores[0].frame_scale_spread == pytest.approx(scores[1].frame_scale_spread, abs=1e-4)
