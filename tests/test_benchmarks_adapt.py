# SPDX-License-Identifier: Apache-2.0
"""The benchmark of ``--adapt``, on a tiny room with a made-up model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import copy_of
from learning_model import Learner

from benchmarks.adapt import FORMAT, main
from slamdepth.depth import registry


@pytest.fixture(autouse=True)
def learner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    registry.register("learner")(lambda *, device="cpu", seed=0: Learner())


def test_each_sequence_without_and_with_it(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "adapt.json"
    assert main([str(tiny_room), "--depth", "learner", "--output", str(output)]) == 0
    told = json.loads(output.read_text())
    assert told["format"] == FORMAT
    off, on = told["rows"]
    assert (off["adapt"], on["adapt"]) == (False, True)
    assert off["frames"] == on["frames"] == 40
    assert "updates" not in off
    assert on["in_use"] is True
    assert on["loss"] == [0.02, 0.01]
    assert on["predicted"] != off["predicted"]  # keyframes' predictions were made anew
    assert on["scale"] == pytest.approx(off["scale"], rel=0.05)
    assert np.isfinite([off[name] for name in ("ate_se3_m", "ate_sim3_m", "metric", "final")]).all()
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 4
    assert lines[3].startswith(f"| {tiny_room.name} | on | ")
    assert "0.0200 -> 0.0100" in lines[3]


def test_a_sequence_without_a_sensor_is_judged_by_its_path_alone(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = copy_of(tiny_room, tmp_path / "room")
    (room / "depth.txt").unlink()
    shutil.rmtree(room / "depth")
    assert main([str(room), "--depth", "learner", "--max-frames", "20"]) == 0
    off = capsys.readouterr().out.strip().splitlines()[2].split(" | ")
    assert off[6:10] == ["-", "-", "-", "-"]
    (room / "groundtruth.txt").unlink()
    assert main([str(room), "--depth", "learner"]) != 0
    assert "has no ground truth to judge by; leave it out" in capsys.readouterr().err
