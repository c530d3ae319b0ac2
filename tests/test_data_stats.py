# SPDX-License-Identifier: Apache-2.0
"""Data sets with depth side by side."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from hypothesis import given
from hypothesis import strategies as st
from sequences import image_rgb, imread, make_sevenscenes, make_tum, write_image

from slamdepth.errors import ConfigError, DatasetError, OutputError
from slamdepth.evaluation.depth_statistics import DepthStatistics
from slamdepth.pipeline.data_stats import StatisticsInterrupted, data_statistics
from slamdepth.pipeline.depth_data import open_depth_data, thinned
from slamdepth.report.data_stats import overview_rows


def place(folder: Path, millimetres: list[int], *, unit: float = 0.001) -> Path:
    """Pairs of 16x12 pixels; the left half of every depth image is unknown."""
    folder.mkdir(parents=True)
    for i, value in enumerate(millimetres):
        raw = np.full((12, 16), value, np.uint16)
        raw[:, :8] = 0
        write_image(folder / f"{i:05d}.jpg", image_rgb(i))
        write_image(folder / f"{i:05d}.png", raw)
    camera = {"width": 16, "height": 12, "fx": 8.0, "fy": 8.0, "cx": 7.5, "cy": 5.5, "depth_unit_m": unit}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


@given(st.lists(st.floats(0.01, 150.0), min_size=1, max_size=60), st.sampled_from([1, 5, 50, 95, 99]))
def test_percentiles_are_right_to_a_millimetre(depths: list[float], percent: int) -> None:
    values, statistics = np.array(depths), DepthStatistics()
    for part in np.array_split(values, 3):
        statistics.add(part[None])
    expected = np.percentile(values, percent, method="inverted_cdf")
    assert statistics.percentile_m(percent) == pytest.approx(expected, abs=0.00101)
    assert (statistics.nearest_m, statistics.farthest_m) == (values.min(), values.max())


def test_counts_sparsity_and_histogram() -> None:
    statistics = DepthStatistics()
    statistics.add(np.array([[0.0, np.nan, np.inf, -1.0]]))
    statistics.add(np.array([[1.0, 1.5, 2.5, 500.0]]))
    figures = statistics.to_dict()
    assert figures["without_depth"] == 0.5
    assert figures["without_depth_per_image"] == {"min": 0.0, "median": 0.5, "max": 1.0}
    assert (figures["min_m"], figures["max_m"]) == (1.0, 500.0)
    assert statistics.histogram(np.array([0.0, 1.2, 2.0, 200.0])).tolist() == [1, 1, 2]
    assert DepthStatistics().to_dict()["p50_m"] is None


def test_every_kind_of_data_side_by_side(tmp_path: Path) -> None:
    place(tmp_path / "pairs" / "near", [500, 700])
    place(tmp_path / "pairs" / "far", [300, 300, 400], unit=0.01)
    data = [tmp_path / "pairs", make_tum(tmp_path / "tum"), make_sevenscenes(tmp_path / "seven")]
    out = tmp_path / "out"
    about = data_statistics(data, output=out)
    far, near, tum, seven = about["sets"]
    assert [one["name"] for one in about["sets"]] == ["far", "near", "tum", "seven"]
    assert (near["pairs"], near["width"], near["height"], near["fx"]) == (2, 16, 12, 8.0)
    assert near["view_deg"] == pytest.approx(90.0)
    assert near["without_depth"] == pytest.approx(0.5)
    assert (near["min_m"], near["p50_m"], near["max_m"]) == pytest.approx((0.5, 0.5, 0.7), abs=0.001)
    assert far["p99_m"] == pytest.approx(4.0, abs=0.001)
    assert tum["pairs"] == 4
    assert (seven["min_m"], seven["max_m"]) == pytest.approx((1.0, 1.002))
    assert seven["without_depth"] == pytest.approx(2 / (640 * 480))
    written = json.loads((out / "data-stats.json").read_text())
    assert [one["p95_m"] for one in written["sets"]] == [one["p95_m"] for one in about["sets"]]
    assert sum(written["sets"][1]["histogram"]) == 2 * 12 * 8
    page = (out / "data-stats.html").read_text()
    assert "near" in page
    assert "data:image/png;base64," in page
    assert imread(out / "histograms.png").shape[1] == 1440
    assert str(tmp_path) not in page + (out / "data-stats.json").read_text()


def test_stride_limit_and_pairs_without_depth(tmp_path: Path) -> None:
    folder = place(tmp_path / "p", list(range(100, 1000, 100)))
    about = data_statistics([folder], stride=2, max_frames=3)
    (one,) = about["sets"]
    assert (one["pairs"], one["images"]) == (9, 3)
    assert (one["min_m"], one["max_m"]) == pytest.approx((0.1, 0.9))
    tum = make_tum(tmp_path / "tum")
    (tum / "depth" / "2.png").unlink()
    (one,) = data_statistics([tum])["sets"]
    assert one["pairs"] == one["images"] == 3


def test_two_of_one_name_are_distinguished(tmp_path: Path) -> None:
    data = [place(tmp_path / a / "desk", [500]) for a in ("one", "two")]
    assert [one["name"] for one in data_statistics(data)["sets"]] == ["one/desk", "two/desk"]


def test_broken_images_are_notes_unless_all_are(tmp_path: Path) -> None:
    folder = place(tmp_path / "p", [500, 600])
    (folder / "00000.png").write_bytes(b"")
    (one,) = data_statistics([folder])["sets"]
    assert one["notes"] == ["1 images cannot be read and are left out"]
    (folder / "00001.png").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"p: no depth image could be read: .*00000\.png"):
        data_statistics([folder], output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_input_and_interruption(tmp_path: Path) -> None:
    folder = place(tmp_path / "p", [500, 600])
    tum = make_tum(tmp_path / "tum")
    (tum / "depth.txt").unlink()
    with pytest.raises(DatasetError, match="has no sensor depth"):
        data_statistics([folder, tum])
    with pytest.raises(ConfigError, match="stride"):
        data_statistics([folder], stride=0)
    with pytest.raises(OutputError, match="is a file"):
        data_statistics([folder], output=folder / "camera.json")
    stop = threading.Event()
    with pytest.raises(StatisticsInterrupted, match="after 1 of 2 images") as stopped:
        data_statistics([folder], progress=lambda *_: stop.set(), stop=stop)
    assert stopped.value.exit_code == 130


def test_the_command_prints_both_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    done = call("data-stats", place(tmp_path / "kitchen", [500, 700]), "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for words in ("kitchen", "16x12", "50.0 %", "median", "0.70", "data-stats.html"):
        assert words in done.stdout, words
    missing = call("data-stats", tmp_path / "nowhere")
    assert missing.returncode == 2
    assert "no such folder" in missing.stderr


def test_frames_are_spread_evenly_and_said_to_be_some(tmp_path: Path) -> None:
    folder = place(tmp_path / "p", list(range(100, 1200, 100)))
    (found,) = open_depth_data(folder)
    assert thinned(found, None, 4) == [0, 3, 7, 10]
    assert thinned(found, None, 1) == [0]
    assert thinned(found, 5, 2) == [0, 10]
    assert thinned(found, None, 11) == thinned(found) == list(range(11))
    about = data_statistics([folder], max_frames=4, output=tmp_path / "out")
    assert (about["sets"][0]["pairs"], about["sets"][0]["images"]) == (11, 4)
    assert overview_rows(about)[1][0][1] == "4 of 11"
    assert overview_rows(data_statistics([folder]))[1][0][1] == "11"
    assert "at most 4 of each, spread evenly over it" in (tmp_path / "out" / "data-stats.html").read_text()


def test_tables_keep_names_whole_in_80_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    names = ["shelf_bin_realsense", "rgbd_dataset_freiburg1_desk_vali"]
    folders = [place(tmp_path / name, list(range(500, 520))) for name in names]
    done = call("data-stats", *folders[:1], "--max-frames", 3)
    lines = done.stdout.splitlines()
    (row,) = [line for line in lines if "16x12" in line]
    assert row.split() == [
        "shelf_bin_realsense",
        "3",
        "of",
        "20",
        "16x12",
        "8",
        "90°",
        "50.0",
        "%",
        "50–50",
        "%",
    ]
    done = call("data-stats", *folders)
    assert max(map(len, done.stdout.splitlines())) <= 80
    for name in names:
        assert done.stdout.count(name) == 2, done.stdout


@pytest.mark.data
def test_the_training_pairs(data_dir: Path) -> None:
    folder = data_dir / "depth_training"
    if not folder.is_dir():
        pytest.skip("depth_training is absent")
    about = data_statistics([folder], stride=25)
    sets = {one["name"]: one for one in about["sets"]}
    assert sets["office_hololens"]["pairs"] == 373
    assert 0.3 < sets["shelf_bin_realsense"]["p50_m"] < 0.6 < sets["cafe_nyu"]["p50_m"] < 3.0
