# SPDX-License-Identifier: Apache-2.0
"""The memory benchmark: its way through a sequence, its arithmetic, and a short run of it."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest

from benchmarks.memory import Sample, TrackerMemory, forth_and_back, growth, main


@pytest.mark.parametrize(
    ("count", "expected"),
    [(1, [0, 0, 0, 0, 0]), (2, [0, 1, 0, 1, 0]), (4, [0, 1, 2, 3, 2, 1, 0, 1, 2])],
)
def test_the_ends_come_once(count: int, expected: list[int]) -> None:
    assert list(itertools.islice(forth_and_back(count), len(expected))) == expected


def test_growth_is_that_of_new_ground() -> None:
    samples = [
        Sample(100, 10, 20.0, 220.0, TrackerMemory(20.0, 1.0, 1.0, observations=0.5, on_disk=1.0)),
        Sample(400, 20, 20.0, 340.0, TrackerMemory(30.0, 2.0, 2.0, observations=2.0, on_disk=4.0)),
    ]
    figures = growth(samples, first_play=100)
    assert figures["keyframe_mib"] == pytest.approx(0.2)
    assert figures["keyframe_disk_mib"] == pytest.approx(0.3)
    assert figures["frame_kib"] == pytest.approx(5.12)
    assert figures["keyframes_per_frame_of_new_ground"] == pytest.approx(0.1)
    # 304 MiB of libraries, 30 of images, then 1,800 keyframes and 18,000 frames
    assert figures["ten_minutes_of_new_ground_mib"] == pytest.approx(304 + 30 + 360 + 90)


def test_a_short_run(tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = tmp_path / "memory.json"
    arguments = ["--data", str(tiny_room.parent), "--sequence", tiny_room.name, "--frames", "90"]
    assert main([*arguments, "--every", "40", "--budget", "0", "--output", str(found)]) == 0
    written = json.loads(found.read_text(encoding="utf-8"))
    assert [s["frames"] for s in written["samples"]] == [40, 80, 90]
    assert written["figures"]["lost"] == 0
    # the kernel counts the two separately
    assert written["figures"]["peak_mib"] > written["samples"][-1]["process_mib"] - 1.0 > 0
    last = written["samples"][-1]["tracker"]
    assert all(value > 0 for value in last.values()), last
    assert "| 90 | " in capsys.readouterr().out
    assert str(tmp_path) not in found.read_text(encoding="utf-8")


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path), "--sequence", "none"]) != 0
    printed = capsys.readouterr().err
    assert printed.startswith("error: ")
    assert "none" in printed
    with pytest.raises(SystemExit):
        main(["--data", str(tmp_path), "--sequence", "none", "--frames", "0"])
    assert "--frames must be at least 1" in capsys.readouterr().err
