# SPDX-License-Identifier: Apache-2.0
"""The benchmark of sub-sequences: which there are, their means, and predictions made once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.depth_cache import CachedDepth, DepthCache
from benchmarks.sub_sequences import in_words, main, means, parse, sub_sequences
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo


def test_every_start_and_every_stride_that_is_long_enough(tiny_room: Path) -> None:
    length = len(list((tiny_room / "rgb").iterdir()))
    starts = f"0,4,{length - 20},{length - 19}"
    asked = parse([str(tiny_room), "--starts", starts, "--strides", "1,2,500", "--depth", "sensor"])
    assert [(c.start, c.stride) for c in sub_sequences(asked)] == [
        (0, 1), (4, 1), (length - 20, 1), *([(0, 2)] if length >= 40 else [])
    ]  # fmt: skip


def test_means_leave_out_what_failed() -> None:
    rows: list[dict[str, Any]] = [
        {"tracked": 1.0, "ate_se3_m": 0.04, "ate_sim3_m": 0.01, "scale": 2.0},
        {"tracked": 0.5, "ate_se3_m": 0.01, "ate_sim3_m": 0.04, "scale": 0.5},
        {"error": "too few poses"},
    ]
    found = means(rows)
    assert (found["runs"], found["failed"], found["tracked"]) == (2, 1, 0.75)
    assert found["ate_sim3_m"] == pytest.approx(0.02)
    assert found["ate_se3_m"] == pytest.approx(0.02)
    assert found["abs_log_scale"] == pytest.approx(np.log(2))
    assert in_words(found).startswith("2 runs, 1 failed: Sim(3) 0.0200 m")
    assert "no run could be scored" in in_words(means(rows[2:]))


def test_a_short_run_with_a_setting(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = tmp_path / "found.json"
    wanted = ["--depth", "sensor", "--starts", "0,5", "--strides", "", "--set", "bundle.window=6"]
    wanted += ["--set", "bundle.fixed=4"]
    assert main([str(tiny_room), *wanted, "--output", str(found)]) == 0
    written = json.loads(found.read_text(encoding="utf-8"))
    assert [(row["start"], row["stride"]) for row in written["rows"]] == [(0, 1), (5, 1)]
    assert written["settings"]["settings"] == {"bundle": {"window": 6, "fixed": 4}}
    assert written["means"]["runs"] == 2
    assert written["means"]["ate_se3_m"] < 0.02
    printed = capsys.readouterr().out
    assert "2 runs: Sim(3) 0.0" in printed
    assert str(tmp_path) not in found.read_text(encoding="utf-8")


def test_a_sub_sequence_may_be_corrupted(tiny_room: Path, tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    wanted = ["--depth", "sensor", "--starts", "3", "--strides", "", "--corruption", "mirrored"]
    assert main([str(tiny_room), *wanted, "--output", str(found)]) == 0
    written = json.loads(found.read_text(encoding="utf-8"))
    assert written["settings"]["corruption"] == "mirrored"
    assert written["rows"][0]["frames"] == 37
    assert written["means"]["ate_se3_m"] < 0.02  # by the mirrored truth, that is


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (["--set", "bundle.windw=6"], "--set: unknown setting 'bundle.windw'"),
        (["--starts", "9999", "--depth", "sensor"], "no sub-sequence has 20 frames"),
        (["--corruption", "rain"], "no corruption 'rain'; there are: as it is, mirrored"),
    ],
)
def test_bad_input_is_one_line(
    tiny_room: Path, wanted: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tiny_room), *wanted]) != 0
    assert capsys.readouterr().err.startswith(f"error: {message}")


@pytest.mark.parametrize(
    "wanted", [["--set", "window=6"], ["--starts", "-1"], ["--strides", "0"], ["--jobs", "0"]]
)
def test_bad_options_end_with_the_usage(tiny_room: Path, wanted: list[str]) -> None:
    with pytest.raises(SystemExit):
        parse([str(tiny_room), *wanted])


class Counting:
    name = "counting"
    kind = DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, *, with_sigma: bool) -> None:
        self.calls, self.with_sigma = 0, with_sigma

    def predict(self, frame: Frame) -> DepthPrediction:
        self.calls += 1
        values = np.full((6, 8), 1.0 + frame.index / 3, np.float32)
        sigma = np.asarray(values / 10, np.float32) if self.with_sigma else None
        return DepthPrediction(values, self.kind, sigma)


@pytest.mark.parametrize("with_sigma", [True, False])
def test_a_frame_is_predicted_once_and_says_the_same_each_time(tmp_path: Path, with_sigma: bool) -> None:
    camera = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
    frames = [Frame(n, n / 10, np.zeros((6, 8, 3), np.uint8), camera) for n in range(3)]
    model = Counting(with_sigma=with_sigma)
    first = [CachedDepth(model, DepthCache(tmp_path / "depth")).predict(frame) for frame in frames]
    again = [CachedDepth(model, DepthCache(tmp_path / "depth")).predict(frame) for frame in frames]
    assert model.calls == 3
    for frame, one, other in zip(frames, first, again, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_allclose(one.values, 1.0 + frame.index / 3, rtol=1e-3)
        assert one.values.dtype == np.float32
        if with_sigma:
            assert one.sigma_log is not None
            assert other.sigma_log is not None
            np.testing.assert_array_equal(one.sigma_log, other.sigma_log)
        else:
            assert one.sigma_log is None
            assert other.sigma_log is None
