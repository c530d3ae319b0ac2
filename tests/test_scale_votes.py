# SPDX-License-Identifier: Apache-2.0
"""How sure the scale of predicted depth is, and how estimates of the scale are combined."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import MadeUpDataset

from slamdepth.config import Config
from slamdepth.depth.alignment import as_given
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.scale_sentence import UNKNOWN, own_sentence
from slamdepth.report import ScaleFacts, ScaleSource
from slamdepth.report.scale import accuracy_text
from slamdepth.scale.estimate import ScaleEstimate, fused
from slamdepth.scale.votes import (
    common_sigma_log,
    distinct_views,
    independent_values,
    judge_votes,
    significant_drift,
)
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, RunStatistics, Trajectory

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def keyframe(number: int, x_m: float, sigma: float | None) -> Keyframe:
    T = np.eye(4)
    T[0, 3] = x_m
    frame = StoredFrame(Frame(number, float(number), np.zeros((24, 32, 3), np.uint8), CAMERA))
    prediction = DepthPrediction(np.full((24, 32), 2.0, np.float32), DepthKind.METRIC, scale_sigma_log=sigma)
    return Keyframe(number, frame, T, np.zeros((0, 2)), 1.0, StoredPrediction(prediction), as_given)


def run_of(votes: np.ndarray, sigma: float | None, step_m: float = 1.0) -> Reconstruction:
    keyframes = tuple(keyframe(n, n * step_m, sigma) for n in range(len(votes)))
    times_s = np.arange(len(votes), dtype=np.float64)
    trajectory = Trajectory(times_s, np.array([k.T_world_camera for k in keyframes]))
    statistics = RunStatistics(scale_votes=tuple(map(float, votes)))
    return Reconstruction(trajectory, keyframes, np.zeros((0, 3)), statistics=statistics)


def noise(count: int, sigma: float, seed: int = 0) -> np.ndarray:
    return sigma * np.random.default_rng(seed).standard_normal(count)


# --- votes ---------------------------------------------------------------------------------


def test_the_error_common_to_a_place_does_not_average_out() -> None:
    few, many = (judge_votes(run_of(noise(n, 0.05), 0.15)) for n in (10, 200))
    assert few.sigma_log is not None
    assert many.sigma_log is not None
    assert many.sigma_log >= 0.15
    assert few.sigma_log > many.sigma_log


def test_votes_that_scatter_more_than_the_model_states_widen_the_interval() -> None:
    calm, wild = (judge_votes(run_of(noise(40, sigma), 0.1)) for sigma in (0.02, 0.4))
    assert calm.sigma_log == pytest.approx(0.1, abs=0.01)
    assert wild.sigma_log is not None
    assert wild.sigma_log > 0.25


def test_a_model_that_states_nothing_leaves_the_accuracy_open() -> None:
    assert judge_votes(run_of(noise(20, 0.1), None)).sigma_log is None
    assert common_sigma_log([None, None, 0.1]) is None
    assert common_sigma_log([None, 0.1, 0.2]) == 0.2
    assert common_sigma_log([]) is None


def test_images_like_nothing_the_model_knows_make_the_scale_unknown() -> None:
    assert common_sigma_log([math.inf, math.inf, 0.1]) == math.inf
    assert common_sigma_log([math.inf, 0.1]) == math.inf
    assert common_sigma_log([math.inf, 0.1, 0.2]) == 0.2
    voted = judge_votes(run_of(noise(9, 0.1), math.inf))
    sentence = own_sentence(ScaleEstimate(ScaleSource.NETWORK, 1.0, voted.sigma_log, "x"), voted)
    assert sentence == UNKNOWN
    assert "give --depth NAME, --marker, --camera-height or --baseline-m" in sentence
    _, facts, _ = settle_scale(
        MadeUpDataset(9),
        run_of(noise(9, 0.1), math.inf),
        PredictionScale(ScaleSource.NETWORK, "x", None),
        Config(),
    )
    assert facts.is_unknown
    assert (facts.uncertainty_log, facts.interval, facts.sentence) == (None, None, UNKNOWN)
    assert "Infinity" not in json.dumps(facts.to_dict())


def test_correlated_votes_count_for_fewer() -> None:
    white = noise(200, 1.0)
    slow = np.convolve(noise(240, 1.0), np.ones(20) / 20, mode="valid")[:200]
    assert independent_values(white) > 100
    assert independent_values(slow) < 40
    assert independent_values(np.linspace(0, 1, 50)) < 6
    assert independent_values(np.zeros(10)) == 1.0


def test_an_outlier_does_not_hide_the_correlation_of_the_others() -> None:
    slow = np.sin(np.linspace(0, 6, 100))
    spoilt = slow.copy()
    spoilt[[13, 50, 77]] += 30.0
    assert independent_values(spoilt) < 3 * independent_values(slow)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 60), st.integers(0, 1000), st.floats(0.01, 100))
def test_independent_votes_are_between_one_and_all_and_free_of_scale(n: int, seed: int, by: float) -> None:
    votes = noise(n, 1.0, seed)
    count = independent_values(votes)
    assert 1.0 <= count <= max(1, n)
    assert independent_values(by * votes) == pytest.approx(count)


def test_views_from_one_place_are_one_view() -> None:
    assert distinct_views(run_of(noise(10, 0.1), None, step_m=0.0).keyframes) == 1
    assert distinct_views(run_of(noise(10, 0.1), None, step_m=1.0).keyframes) == 10
    assert judge_votes(run_of(noise(50, 0.1), 0.1, step_m=0.0)).independent == 1.0


def test_a_drift_is_told_from_scatter() -> None:
    drift = significant_drift(np.linspace(0.0, 0.5, 40) + noise(40, 0.03))
    assert drift == pytest.approx(0.5, abs=0.1)
    assert significant_drift(noise(40, 0.1)) is None
    assert significant_drift(noise(5, 0.1)) is None
    voted = judge_votes(run_of(np.linspace(-0.25, 0.25, 40) + noise(40, 0.03), 0.1))
    sentence = own_sentence(ScaleEstimate(ScaleSource.NETWORK, 1.0, voted.sigma_log, "x"), voted)
    assert "they drift by a factor of 1.6" in sentence
    assert voted.sigma_log is not None
    assert voted.sigma_log > 0.15


# --- the interval --------------------------------------------------------------------------


def test_the_interval_is_said_in_words_and_in_numbers() -> None:
    assert accuracy_text(0.1655) == "0.85 to 1.18 of true metres, two in three"
    assert accuracy_text(0.004) == "0.9960 to 1.0040 of true metres, two in three"
    facts = ScaleFacts(ScaleSource.NETWORK, 1.0, "", uncertainty_log=0.1)
    assert json.loads(json.dumps(facts.to_dict()))["interval"] == pytest.approx([0.905, 1.105], abs=1e-3)
    assert ScaleFacts(ScaleSource.NETWORK, 1.0, "").to_dict()["interval"] is None


# --- fusion --------------------------------------------------------------------------------


def estimate(factor: float, sigma: float | None, source: ScaleSource = ScaleSource.BASELINE) -> ScaleEstimate:
    return ScaleEstimate(source, factor, sigma, "")


def test_estimates_that_agree_are_combined_by_inverse_variance_of_the_log() -> None:
    a, b = estimate(1.0, 0.2, ScaleSource.NETWORK), estimate(1.2, 0.1)
    result = fused([a, b])
    assert result.weights == pytest.approx((0.2, 0.8))
    assert math.log(result.factor) == pytest.approx(0.8 * math.log(1.2))
    assert result.sigma_log == pytest.approx(1 / math.sqrt(125))
    assert not result.contradict


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_single_wrong_estimate_is_outvoted_however_sure_it_is(wrong: int) -> None:
    three = [estimate(1.0, 0.03), estimate(1.02, 0.02), estimate(0.99, 0.01)]
    three[wrong] = estimate(3.0, 0.001)
    result = fused(three)
    assert result.weights[wrong] == 0.0
    assert result.factor == pytest.approx(1.0, abs=0.03)


def test_what_is_measured_outvotes_what_is_predicted() -> None:
    result = fused([estimate(1.0, 0.1, ScaleSource.NETWORK), estimate(15.0, 0.05)])
    assert result.factor == pytest.approx(15.0)
    assert result.weights == (0.0, 1.0)


def test_two_that_contradict_each_other_widen_the_interval() -> None:
    result = fused([estimate(1.0, 0.02), estimate(2.0, 0.02)])
    assert result.contradict
    assert result.sigma_log > 0.3
    third = fused([estimate(2.1, 0.2, ScaleSource.NETWORK), estimate(1.0, 0.02), estimate(2.0, 0.02)])
    assert third.weights[1] == 0.0
    assert not third.contradict


def test_an_estimate_without_an_uncertainty_gets_no_weight() -> None:
    known = estimate(2.0, 0.1)
    for sigma in (None, math.inf):
        assert fused([estimate(1.0, sigma, ScaleSource.NETWORK), known]).weights == (0.0, 1.0)
    with pytest.raises(ValueError, match="no estimate has a finite uncertainty"):
        fused([estimate(1.0, None)])


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.5, 2.0), st.floats(0.01, 0.5)), min_size=1, max_size=5),
    st.floats(0.01, 100.0),
)
def test_the_combination_lies_between_and_does_not_depend_on_the_unit(
    made: list[tuple[float, float]], unit: float
) -> None:
    some = [estimate(factor, sigma) for factor, sigma in made]
    result = fused(some)
    used = [one.factor for one, weight in zip(some, result.weights, strict=True) if weight > 0]
    assert min(used) * (1 - 1e-9) <= result.factor <= max(used) * (1 + 1e-9)
    assert sum(result.weights) == pytest.approx(1.0)
    other = fused([estimate(unit * factor, sigma) for factor, sigma in made])
    assert other.factor == pytest.approx(unit * result.factor)
