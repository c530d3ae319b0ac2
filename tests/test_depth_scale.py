# SPDX-License-Identifier: Apache-2.0
"""A scale of predicted depth: fitted, kept in a file, applied."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from slamdepth.depth.robust_centre import robust_centre
from slamdepth.depth.robust_line import robust_line
from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit, fit_scale
from slamdepth.depth.scale_file import check_same_model, read_scale, write_scale
from slamdepth.depth.scaled import ScaledDepth
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.evaluation.bootstrap import block_resamples
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
FRAMES = 25


def frame(number: int) -> Frame:
    rng = np.random.default_rng(number)
    depth_m = rng.uniform(0.5, 6.0, (48, 64)).astype(np.float32)
    depth_m[:4] = 0.0
    return Frame(number, number / 10, np.full((48, 64, 3), number, np.uint8), CAMERA, depth_m)


class Network:
    """Predicts true depth as a linear map of it, with errors of its own."""

    weights: tuple[WeightsInfo, ...] = (WeightsInfo("net", "ab" * 32, "rooms", "MIT"),)

    def __init__(
        self,
        kind: DepthKind = DepthKind.METRIC,
        scale: float = 1.0,
        shift: float = 0.0,
        frame_sigma: float = 0.0,
        outliers: float = 0.0,
        name: str = "net",
    ) -> None:
        self.kind, self.name = kind, name
        self.truth = DepthScale(scale, shift, ScaleDomain.of(kind))
        self.frame_sigma, self.outliers = frame_sigma, outliers

    def predict(self, frame: Frame) -> DepthPrediction:
        assert frame.depth_m is not None
        rng = np.random.default_rng([frame.index, 7])
        z = np.where(frame.depth_m > 0, frame.depth_m, 1.0).astype(np.float64)
        z *= np.exp(self.frame_sigma * rng.standard_normal())
        z[rng.uniform(size=z.shape) < self.outliers] *= 3.0
        line = z if self.truth.domain is ScaleDomain.DEPTH else 1.0 / z
        values = ((line - self.truth.shift) / self.truth.scale).astype(np.float32)
        return DepthPrediction(values, self.kind, np.full(values.shape, 0.2, np.float32))


def fit(model: Network, *, with_shift: bool = False, frames: int = FRAMES) -> ScaleFit:
    return fit_scale(model, map(frame, range(frames)), with_shift=with_shift, sequence="room")


# --- fitting ---------------------------------------------------------------------------


def test_an_exact_scale_is_found_exactly() -> None:
    found = fit(Network(scale=0.8))
    assert found.scale.scale == pytest.approx(0.8, rel=1e-5)
    assert (found.scale.shift, found.shift_sigma) == (0.0, None)
    assert found.scale_sigma_log == pytest.approx(0.0, abs=1e-5)
    assert found.frame_spread_log == pytest.approx(0.0, abs=1e-5)
    assert (found.frames, found.pixels) == (FRAMES, FRAMES * 11 * 16)


@pytest.mark.parametrize(
    ("kind", "scale", "shift"),
    [
        (DepthKind.METRIC, 0.7, 0.3),
        (DepthKind.METRIC, 1.2, -0.2),
        (DepthKind.AFFINE_DEPTH, 2.0, 0.4),
        (DepthKind.AFFINE_INVERSE_DEPTH, 0.05, 0.1),
        (DepthKind.AFFINE_INVERSE_DEPTH, 3.0, -0.1),
    ],
)
@pytest.mark.parametrize("outliers", [0.0, 0.25])
def test_scale_and_shift_are_found_in_the_domain_of_the_kind(
    kind: DepthKind, scale: float, shift: float, outliers: float
) -> None:
    found = fit(Network(kind, scale, shift, outliers=outliers), with_shift=True)
    assert found.scale.domain is ScaleDomain.of(kind)
    assert found.scale.scale == pytest.approx(scale, rel=0.01)
    assert found.scale.shift == pytest.approx(shift, abs=0.01)


def test_outliers_do_not_move_the_scale() -> None:
    assert fit(Network(scale=0.8, outliers=0.3)).scale.scale == pytest.approx(0.8, rel=1e-5)


@pytest.mark.parametrize("with_shift", [False, True])
def test_the_standard_error_depends_on_frames_and_not_on_pixels(with_shift: bool) -> None:
    sigma, frames = 0.2, 64
    found = fit(Network(scale=0.8, frame_sigma=sigma), with_shift=with_shift, frames=frames)
    assert found.scale_sigma_log is not None
    # of a mean it would be sigma / sqrt(frames), of a median a quarter more
    assert 0.6 < found.scale_sigma_log / (sigma / np.sqrt(frames)) < 2.2
    assert found.frame_spread_log == pytest.approx(sigma, rel=0.4)
    if not with_shift:
        assert abs(np.log(found.scale.scale / 0.8)) < 4 * found.scale_sigma_log


def test_one_frame_gives_a_scale_without_a_standard_error() -> None:
    found = fit(Network(scale=0.8), frames=1)
    assert found.scale.scale == pytest.approx(0.8, rel=1e-5)
    assert found.scale_sigma_log is None


def test_what_cannot_be_fitted_is_one_clear_error() -> None:
    with pytest.raises(ConfigError, match=r"up to scale and shift.*--shift"):
        fit(Network(DepthKind.AFFINE_INVERSE_DEPTH, 0.1))
    with pytest.raises(ConfigError, match="in metres already"):
        fit_scale(SensorDepth(), [frame(0)], with_shift=False, sequence="room")
    with pytest.raises(DatasetError, match="room: no frame has sensor depth"):
        fit_scale(Network(), [replace(frame(0), depth_m=None)], with_shift=False, sequence="room")
    with pytest.raises(DatasetError, match="falls where the sensor's rises"):
        fit(Network(DepthKind.AFFINE_DEPTH, -1.0, 8.0), with_shift=True)

    class Flat(Network):
        def predict(self, frame: Frame) -> DepthPrediction:
            return DepthPrediction(np.full((48, 64), 2.0, np.float32), self.kind)

    with pytest.raises(DatasetError, match="the same value everywhere"):
        fit(Flat(), with_shift=True)


@given(slope=st.floats(0.01, 100), share=st.floats(-0.5, 2.0), seed=st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_a_line_is_recovered_for_any_slope_and_intercept(slope: float, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform(1.0, 5.0, 200)
    intercept = share * slope  # keeps the line positive over x
    y = slope * x + intercept
    bad = y.copy()
    bad[:40] *= rng.uniform(2.0, 4.0, 40)
    found = robust_line(x, bad)
    assert found[0] == pytest.approx(slope, rel=1e-2)
    assert found[1] == pytest.approx(intercept, abs=2e-2 * slope)


def test_uncertain_far_depth_does_not_bias_a_line() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(0.5, 8.0, 20_000)
    y = (1.3 * x + 0.2) * rng.gamma(25.0, 1 / 25.0, len(x))  # 20 % relative error of mean 1
    slope, intercept, spread = robust_line(x, y)
    assert slope * 4 + intercept == pytest.approx(5.4, rel=0.02)
    assert spread == pytest.approx(0.2, rel=0.1)


# --- resampling ------------------------------------------------------------------------


def test_blocks_keep_neighbours_together() -> None:
    rows = block_resamples(100, resamples=50, seed=1)
    assert rows.shape == (50, 100)
    assert rows.min() >= 0
    assert rows.max() < 100
    follows = (np.diff(rows, axis=1) % 100 == 1).mean()
    assert follows > 0.85  # blocks of ten: nine of ten steps stay inside one
    np.testing.assert_array_equal(rows, block_resamples(100, resamples=50, seed=1))
    with pytest.raises(ValueError, match="positive"):
        block_resamples(0)


def test_a_block_bootstrap_accounts_for_correlated_neighbours() -> None:
    rng = np.random.default_rng(3)
    walk = np.repeat(rng.standard_normal(40), 10)  # ten frames share an error
    alone = walk[block_resamples(400, block=1)].mean(axis=1).std()
    blocks = walk[block_resamples(400)].mean(axis=1).std()
    true = 1 / np.sqrt(40)
    assert alone < 0.5 * true
    assert 0.6 * true < blocks < 1.4 * true


# --- applying --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(DepthKind))
def test_a_fitted_scale_gives_metric_depth(kind: DepthKind) -> None:
    model = Network(kind, 0.5, 0.2)
    scaled = ScaledDepth(model, fit(model, with_shift=True).scale)
    prediction = scaled.predict(frame(3))
    assert prediction.kind is scaled.kind is DepthKind.METRIC
    assert (scaled.name, scaled.weights) == ("net", model.weights)
    truth = frame(3).depth_m
    assert truth is not None
    known = (truth > 0) & (prediction.values > 0)
    assert known.mean() > 0.9
    np.testing.assert_allclose(prediction.values[known], truth[known], rtol=1e-3)


def test_a_scale_alone_leaves_the_uncertainty_unchanged() -> None:
    prediction, truth = ScaledDepth(Network(), DepthScale(1.5)).predict(frame(0)), frame(0).depth_m
    assert truth is not None
    np.testing.assert_allclose(prediction.values[8:], 1.5 * truth[8:], rtol=1e-6)
    np.testing.assert_array_equal(prediction.sigma_log, np.full((48, 64), np.float32(0.2)))


@pytest.mark.parametrize("kind", [DepthKind.METRIC, DepthKind.AFFINE_INVERSE_DEPTH])
def test_a_shift_propagates_the_uncertainty(kind: DepthKind) -> None:
    model, scale = Network(kind), DepthScale(0.9, 0.3, ScaleDomain.of(kind))
    at = model.predict(frame(0)).values[10:20, 10:20].astype(np.float64)
    step = 1e-4
    derivative = (scale.depth_m(at * (1 + step)) / scale.depth_m(at).astype(np.float64) - 1) / step
    sigma_log = ScaledDepth(model, scale).predict(frame(0)).sigma_log
    assert sigma_log is not None
    np.testing.assert_allclose(sigma_log[10:20, 10:20], 0.2 * np.abs(derivative), rtol=2e-2)


def test_depth_behind_the_camera_is_unknown() -> None:
    values: NDArray[np.float32] = np.array([[0.0, 1.0, 2.0, np.nan, np.inf, -1.0]], np.float32)
    scale = DepthScale(1.0, -1.5)
    np.testing.assert_array_equal(scale.depth_m(values), [[0, 0, 0.5, 0, 0, 0]])


def test_scales_that_cannot_make_a_model_metric_are_refused() -> None:
    with pytest.raises(ConfigError, match="metres already"):
        ScaledDepth(SensorDepth(), DepthScale(2.0))
    relative = Network(DepthKind.AFFINE_INVERSE_DEPTH)
    with pytest.raises(ConfigError, match="a scale alone does not make it metric"):
        ScaledDepth(relative, DepthScale(2.0, 0.0, ScaleDomain.INVERSE_DEPTH))
    with pytest.raises(ConfigError, match="scale of depth cannot be applied"):
        ScaledDepth(relative, DepthScale(2.0, 1.0))


# --- the file --------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [1, 9])
def test_a_file_gives_back_what_was_written(tmp_path: Path, frames: int) -> None:
    written = fit(Network(DepthKind.AFFINE_INVERSE_DEPTH, 0.2, 0.1), with_shift=True, frames=frames)
    write_scale(tmp_path / "s.yaml", written)
    assert read_scale(tmp_path / "s.yaml") == written
    text = (tmp_path / "s.yaml").read_text()
    assert "1 / depth in metres = scale * prediction + shift (in 1/m)" in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("scale: ", "scale: -"), "scale is out of range"),
        (("scale: ", "scale: x"), "scale must be a number"),
        (("scale_sigma_log:", "sigma:"), "'scale_sigma_log' is missing"),
        (("frames: 9", "frames: 9\nextra: 1"), "unknown entry 'extra'"),
        (("domain: depth", "domain: volume"), "volume"),
        (("domain: depth", "domain: inverse depth"), "is not scaled as inverse depth"),
        (("format: slamdepth depth scale 1", "format: 2"), "not a depth scale"),
        (("sha256:", "sha:"), "sha"),
        (("format:", "[:"), "not valid YAML"),
    ],
)
def test_a_broken_file_is_one_clear_error(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = tmp_path / "s.yaml"
    write_scale(path, fit(Network(), frames=9))
    text = path.read_text()
    changed = re.sub(f"^( *){re.escape(change[0])}", rf"\g<1>{change[1]}", text, flags=re.MULTILINE)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(ConfigError) as caught:
        read_scale(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_an_error_that_lists_the_choices(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give a number, a file of 'slamdepth scale', or groundtruth"):
        read_scale(tmp_path / "absent.yaml")


def test_a_scale_of_another_model_or_other_weights_is_refused() -> None:
    made = fit(Network(), frames=2)
    check_same_model(made, Network(), "s.yaml")
    with pytest.raises(ConfigError, match=r"s\.yaml: is the scale of 'net' .*'other'"):
        check_same_model(made, Network(name="other"), "s.yaml")
    with pytest.raises(ConfigError, match="affine depth"):
        check_same_model(made, Network(DepthKind.AFFINE_DEPTH), "s.yaml")
    retrained = Network()
    retrained.weights = (WeightsInfo("net", "cd" * 32, "rooms", "MIT"),)
    with pytest.raises(ConfigError, match=r"other weights of 'net'.*net, sha256 cdcdcdcdcdcd"):
        check_same_model(made, retrained, "s.yaml")


def test_the_robust_centre_tolerates_outliers_and_varies_less_than_the_median() -> None:
    rng = np.random.default_rng(0)
    centres, medians = [], []
    for _ in range(300):
        votes = rng.normal(0.2, 0.1, 27)
        votes[:5] = 3.0
        centres.append(robust_centre(votes))
        votes = rng.normal(0.2, 0.1, 27)
        medians.append((robust_centre(votes), np.median(votes)))
    assert np.abs(np.array(centres) - 0.2).max() < 0.15
    of_centre, of_median = np.std(medians, axis=0)
    assert of_centre < 0.9 * of_median
    assert robust_centre(np.array([0.7])) == 0.7
    assert robust_centre(np.linspace(-1.0, 1.0, 5001)) == pytest.approx(0.0, abs=1e-3)
