# SPDX-License-Identifier: Apache-2.0
"""Sequences whose lists have times in other units than seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sequences import make_tum

from slamdepth.datasets import open_dataset
from slamdepth.errors import DatasetError

START_NS = 1403636579763555584
STAMPS: dict[str, tuple[Callable[[float], str], float]] = {
    "nanoseconds": (lambda t: str(START_NS + round(t * 1e9)), 1403636579.763555584),
    "microseconds": (lambda t: str((START_NS + round(t * 1e9)) // 1000), 1403636579.763555),
    "milliseconds": (lambda t: f"{1000 * t:.0f}", 0.0),
}


def in_seconds(time_s: float) -> str:
    return f"{time_s:.6f}"


def with_times(folder: Path, stamps: dict[str, Callable[[float], str]]) -> Path:
    """A TUM folder of 12 frames at 30 Hz; ``stamps`` writes the times of its lists, seconds by default."""
    make_tum(folder, 12)
    for name in ("rgb", "depth", "groundtruth"):
        stamp = stamps.get(name, in_seconds)
        rest = "0 0 0 0 0 0 1" if name == "groundtruth" else f"{name}/NUMBER.png"
        lines = [f"{stamp(i / 30)} {rest.replace('NUMBER', str(i))}\n" for i in range(12)]
        (folder / f"{name}.txt").write_text("".join(lines))
    return folder


@pytest.mark.parametrize("unit", STAMPS)
def test_times_in_other_units_are_converted_with_a_note_for_each_list(tmp_path: Path, unit: str) -> None:
    stamp, start_s = STAMPS[unit]
    dataset = open_dataset(with_times(tmp_path, dict.fromkeys(("rgb", "depth", "groundtruth"), stamp)))
    tolerance_s = 6e-4 if unit == "milliseconds" else 2e-6
    np.testing.assert_allclose(dataset.timestamps_s, start_s + np.arange(12) / 30, rtol=0, atol=tolerance_s)
    assert dataset.ground_truth is not None
    np.testing.assert_array_equal(dataset.ground_truth.timestamps_s, dataset.timestamps_s)
    assert all(dataset.read(i, with_depth=True).depth_m is not None for i in range(12))
    assert len(dataset.notes) == 3
    for name, note in zip(("rgb", "depth", "groundtruth"), dataset.notes, strict=True):
        assert note.startswith(f"{name}.txt: times are in {unit} by their size and spacing (")


def test_lists_may_have_different_units(tmp_path: Path) -> None:
    def seconds(t: float) -> str:
        return f"{1403636579.763556 + t:.6f}"

    nanoseconds = STAMPS["nanoseconds"][0]
    folder = with_times(tmp_path, {"rgb": seconds, "depth": nanoseconds, "groundtruth": nanoseconds})
    dataset = open_dataset(folder)
    assert all(dataset.read(i, with_depth=True).depth_m is not None for i in range(12))
    assert [note.split(" ")[0] for note in dataset.notes] == ["depth.txt:", "groundtruth.txt:"]


def test_ground_truth_follows_the_images_where_its_unit_is_not_clear(tmp_path: Path) -> None:
    folder = with_times(tmp_path, {"rgb": STAMPS["milliseconds"][0], "depth": STAMPS["milliseconds"][0]})
    (folder / "groundtruth.txt").write_text("".join(f"{10 * i} 0 0 0 0 0 0 1\n" for i in range(40)))
    dataset = open_dataset(folder)
    assert dataset.ground_truth is not None
    assert dataset.ground_truth.timestamps_s[-1] == pytest.approx(0.39)


def test_a_header_states_the_unit(tmp_path: Path) -> None:
    folder = with_times(tmp_path, {"rgb": lambda t: f"{900 * t:.0f}", "depth": lambda t: f"{900 * t:.0f}"})
    (folder / "groundtruth.txt").unlink()
    for name in ("rgb", "depth"):
        text = (folder / f"{name}.txt").read_text()
        (folder / f"{name}.txt").write_text("# timestamp [ms] filename\n" + text)
    dataset = open_dataset(folder)
    assert dataset.timestamps_s[-1] == pytest.approx(0.33)
    assert "milliseconds as its header says" in dataset.notes[0]


def test_times_in_no_unit_are_refused(tmp_path: Path) -> None:
    folder = with_times(tmp_path, {"rgb": lambda t: str(130_000_000_000_000_000 + round(t * 1e7))})
    with pytest.raises(DatasetError, match=r"rgb\.txt: times such as 13.* are neither seconds, milliseconds"):
        open_dataset(folder)
