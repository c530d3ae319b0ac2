# SPDX-License-Identifier: Apache-2.0
"""Judgements of predictions whose error is known: perfect, scaled, affine, wobbling, unsure."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from slamdepth.evaluation import DepthJudge, DepthJudgement
from slamdepth.evaluation.depth_judge import FIGURES, WAYS
from slamdepth.io import write_json
from slamdepth.types import DepthKind, DepthPrediction


def room(seed: int = 0) -> np.ndarray:
    """Smooth depth with steps, 48 x 64, 0.8 to about 5 m."""
    rng = np.random.default_rng(seed)
    depth = np.full((48, 64), 1.0) + np.linspace(0, 1, 64) + np.linspace(0, 0.5, 48)[:, None]
    depth[10:30, 20:40] = 0.8
    depth[:, 50:] *= rng.uniform(1.5, 2.0)
    return depth.astype(np.float32)


def judged(
    predictions: list[np.ndarray],
    sensors: list[np.ndarray],
    kind: DepthKind = DepthKind.METRIC,
    sigma: float | None = None,
) -> DepthJudgement:
    judge = DepthJudge(kind, stride=1)
    for values, sensor in zip(predictions, sensors, strict=True):
        sigma_log = None if sigma is None else np.full(values.shape, sigma, np.float32)
        assert judge.add(DepthPrediction(values.astype(np.float32), kind, sigma_log), sensor)
    judgement = judge.judge()
    assert judgement is not None
    return judgement


def is_perfect(judgement: DepthJudgement, way: str, tolerance: float = 1e-5) -> None:
    figures = {name: figure.value for name, figure in judgement.ways[way].items()}
    assert set(figures) == set(FIGURES)
    for name in ("abs_rel", "rmse_m", "log_rmse", "edge_error_px"):
        assert figures[name] == pytest.approx(0.0, abs=tolerance)
    for name in ("delta1", "delta2", "delta3", "ssim", "edge_f1"):
        assert figures[name] == pytest.approx(1.0, abs=tolerance)


ROOMS = [room(k) for k in range(10)]


def test_a_perfect_prediction() -> None:
    judgement = judged(ROOMS, ROOMS)
    assert tuple(judgement.ways) == WAYS
    for way in WAYS:
        is_perfect(judgement, way)
    assert judgement.sequence_factor == pytest.approx(1.0)
    assert judgement.scale_spread.value == pytest.approx(0.0, abs=1e-7)
    assert (judgement.frames, judgement.pixels, judgement.coverage) == (10, 10 * 48 * 64, 1.0)
    assert judgement.surest_half is None
    assert judgement.within_one_sigma is None


def test_a_scaled_one_is_mended_by_one_factor() -> None:
    judgement = judged([r * 0.8 for r in ROOMS], ROOMS)
    as_predicted = judgement.ways["as_predicted"]
    assert as_predicted["abs_rel"].value == pytest.approx(0.2, rel=1e-5)
    assert as_predicted["abs_rel"].low == pytest.approx(0.2, rel=1e-5)
    assert as_predicted["log_rmse"].value == pytest.approx(-math.log(0.8), rel=1e-5)
    assert as_predicted["delta2"].value == 1.0
    assert as_predicted["edge_f1"].value == pytest.approx(1.0)  # a factor moves no edge
    assert as_predicted["ssim"].value < 0.99
    assert judgement.sequence_factor == pytest.approx(1.25, rel=1e-5)
    for way in WAYS[1:]:
        is_perfect(judgement, way)


def test_a_wobbling_one_needs_a_factor_a_frame() -> None:
    factors = [0.5, 2.0] * 5
    judgement = judged([r * f for r, f in zip(ROOMS, factors, strict=True)], ROOMS)
    assert judgement.ways["sequence_median"]["abs_rel"].value > 0.3
    is_perfect(judgement, "frame_median")
    assert judgement.scale_spread.value == pytest.approx(math.log(2), rel=1e-5)


def test_a_shifted_one_needs_the_affine_fit() -> None:
    judgement = judged([2 * r + 0.5 for r in ROOMS], ROOMS)
    assert judgement.ways["frame_median"]["abs_rel"].value > 0.04
    is_perfect(judgement, "frame_affine")
    assert judgement.fitted_in == "depth"


def test_relative_disparity_is_judged_without_metres() -> None:
    kind = DepthKind.AFFINE_INVERSE_DEPTH
    judgement = judged([7 / r + 3 for r in ROOMS], ROOMS, kind, sigma=0.1)
    assert tuple(judgement.ways) == WAYS[1:]
    is_perfect(judgement, "frame_affine")
    assert judgement.ways["frame_median"]["abs_rel"].value > 0.05
    assert judgement.fitted_in == "inverse depth"
    assert judgement.surest_half is not None
    assert judgement.within_one_sigma is None
    unshifted = judged([7 / r for r in ROOMS], ROOMS, kind)
    is_perfect(unshifted, "sequence_median")


def test_the_range_of_the_sensor_and_missing_pixels() -> None:
    sensor, predicted = room(), room()
    sensor[:10] = 12.0
    sensor[10:20] = 0.0
    predicted[20:30] = np.nan
    judgement = judged([predicted], [sensor])
    assert judgement.pixels == 18 * 64
    assert judgement.coverage == pytest.approx(18 / 28)
    is_perfect(judgement, "as_predicted")
    assert judgement.ways["as_predicted"]["abs_rel"].low is None  # one frame tells no interval


def test_sigma_by_hand() -> None:
    """Right on the left half with a small sigma, 10 % off on the right one with a large sigma."""
    sensor = np.full((8, 8), 2.0, np.float32)
    predicted, sigma = sensor.copy(), np.full((8, 8), 0.05, np.float32)
    predicted[:, 4:] *= np.float32(1.1)
    sigma[:, 4:] = 0.08
    judge = DepthJudge(DepthKind.METRIC, stride=1)
    judge.add(DepthPrediction(predicted, DepthKind.METRIC, sigma), sensor)
    judgement = judge.judge()
    assert judgement is not None
    assert judgement.surest_half is not None
    assert judgement.within_one_sigma is not None
    assert judgement.within_one_sigma.value == pytest.approx(0.5)  # log 1.1 = 0.095 is above 0.08
    # The median lies between the halves: 2 % of e^(0.095/2) either way, nearly equal errors.
    half = math.log(1.1) / 2
    low, high = -math.expm1(-half), math.expm1(half)
    assert judgement.surest_half.value == pytest.approx(low / ((low + high) / 2), rel=1e-4)


def test_many_frames_spill_to_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slamdepth.evaluation.depth_judge._IN_MEMORY_BYTES", 1000)
    judgement = judged([r * 0.8 for r in ROOMS], ROOMS)
    is_perfect(judgement, "sequence_median")
    assert judgement.ways["as_predicted"]["abs_rel"].value == pytest.approx(0.2, rel=1e-5)


def test_errors_over_depth() -> None:
    near, far = np.full((8, 8), 1.0, np.float32), np.full((8, 8), 4.0, np.float32)
    judgement = judged([near * 1.1, far * 0.8], [near, far])
    over = judgement.over_depth
    filled = [k for k, n in enumerate(over.pixels) if n]
    assert [over.pixels[k] for k in filled] == [64, 64]
    assert over.edges_m[filled[0]] <= 1.0 < over.edges_m[filled[0] + 1]
    assert [over.abs_rel["as_predicted"][k] for k in filled] == pytest.approx([0.1, 0.2], rel=1e-5)
    biases = [over.log_bias["as_predicted"][k] for k in filled]
    assert biases == pytest.approx([math.log(1.1), math.log(0.8)], rel=1e-5)
    assert all(over.abs_rel["as_predicted"][k] is None for k in range(24) if k not in filled)


def test_it_writes_as_json(tmp_path: Path) -> None:
    flat = [np.full((8, 8), 2.0, np.float32)]  # no edge: a figure no frame has
    write_json(tmp_path / "judged.json", judged(flat, flat).to_dict())
    figures = json.loads((tmp_path / "judged.json").read_text())
    assert figures["kind"] == "metric depth"
    assert figures["ways"]["frame_affine"]["ssim"]["value"] == pytest.approx(1.0)
    assert figures["ways"]["frame_affine"]["edge_f1"]["value"] is None
    assert figures["per_frame"]["as_predicted.abs_rel"] == [0.0]


def test_wrong_use() -> None:
    judge = DepthJudge(DepthKind.METRIC)
    assert judge.judge() is None
    with pytest.raises(ValueError, match="was given affine depth"):
        judge.add(DepthPrediction(ROOMS[0], DepthKind.AFFINE_DEPTH), ROOMS[0])
    with pytest.raises(ValueError, match="one \\(H, W\\)"):
        judge.add(DepthPrediction(ROOMS[0][:5], DepthKind.METRIC), ROOMS[0])
    assert not judge.add(DepthPrediction(ROOMS[0] * 0, DepthKind.METRIC), ROOMS[0])
    with pytest.raises(ValueError, match="min_m"):
        DepthJudge(DepthKind.METRIC, min_m=3, max_m=2)
