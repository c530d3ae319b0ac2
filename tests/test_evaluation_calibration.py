# SPDX-License-Identifier: Apache-2.0
"""Expected against observed coverage of predicted standard deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamdepth.evaluation.calibration import EXPECTED, coverage_of
from slamdepth.evaluation.depth_judge import DepthJudge, DepthJudgement
from slamdepth.report.depth_calibration import write_calibration
from slamdepth.types import DepthKind, DepthPrediction

ONE, TWO = EXPECTED.index(0.6827), EXPECTED.index(0.9545)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_curve_of_gaussian_errors(factor: float) -> None:
    error = np.random.default_rng(0).normal(0, 0.3, 20_000)
    curve = coverage_of(error, np.full(len(error), 0.3 * factor))
    if factor == 1.0:
        assert curve.observed == pytest.approx(EXPECTED, abs=0.01)
    else:
        differences = np.array(curve.observed) - EXPECTED
        assert (np.sign(differences) == np.sign(factor - 1.0)).all()
    assert (np.diff(curve.observed) >= 0).all()


def test_errors_of_unknown_deviation_are_counted_and_left_out() -> None:
    curve = coverage_of(np.array([0.1, 0.1, 9.0, 9.0]), np.array([0.2, 0.2, np.inf, np.inf]))
    assert curve.observed[ONE] == 1.0
    assert (curve.known, curve.cases) == (0.5, 4)


def test_no_known_deviation_gives_no_curve() -> None:
    curve = coverage_of(np.ones(3), np.full(3, np.inf))
    assert np.isnan(curve.observed).all()
    assert curve.known == 0.0


def judged(scale_sigma: float | None, pixel_sigma: float | None = 0.1) -> DepthJudgement:
    """40 frames whose scale errs by 0.3, and pixels by 0.1, in the logarithm."""
    rng = np.random.default_rng(1)
    judge = DepthJudge(DepthKind.METRIC, stride=1)
    for _ in range(40):
        sensor = np.full((24, 32), 2.0, np.float32)
        values = sensor * np.exp(rng.normal(0, 0.3) + rng.normal(0, 0.1, sensor.shape)).astype(np.float32)
        sigma = None if pixel_sigma is None else np.full(sensor.shape, pixel_sigma, np.float32)
        prediction = DepthPrediction(values, DepthKind.METRIC, sigma, scale_sigma_log=scale_sigma)
        assert judge.add(prediction, sensor)
    judgement = judge.judge()
    assert judgement is not None
    return judgement


def test_pixels_and_scales_are_judged_apart() -> None:
    judgement = judged(0.3)
    assert judgement.pixel_coverage is not None
    assert judgement.scale_coverage is not None
    assert judgement.pixel_coverage.observed == pytest.approx(EXPECTED, abs=0.02)
    assert judgement.scale_coverage.observed[ONE] == pytest.approx(0.68, abs=0.15)
    assert judgement.scale_coverage.observed[TWO] > 0.85


def test_a_scale_believed_too_much_is_seen() -> None:
    narrow = judged(0.05).scale_coverage
    assert narrow is not None
    assert narrow.observed[TWO] < 0.5


def test_a_model_without_uncertainty_has_no_curves(tmp_path: Path) -> None:
    judgement = judged(None, None)
    assert judgement.pixel_coverage is None
    assert judgement.scale_coverage is None
    assert not write_calibration(tmp_path / "x.png", {"hall": judgement}, "network")
    assert not list(tmp_path.iterdir())


def test_the_plot_says_where_the_scale_is_unknown(tmp_path: Path) -> None:
    file = tmp_path / "x.png"
    assert write_calibration(file, {"hall": judged(0.3), "street": judged(float("inf"))}, "network")
    assert file.read_bytes().startswith(b"\x89PNG")
