# SPDX-License-Identifier: Apache-2.0
"""Stopping a command: Ctrl-C and SIGTERM finish a run, and after kill -9 its trajectory can be read."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ENVIRONMENT, call, command, make_long

from slamdepth.io import read_tum_trajectory
from slamdepth.synth import sequence

PATIENCE_S = 600.0  # for a loaded machine; an idle one needs 2 s


@pytest.fixture(scope="module")
def long_room(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_long(tiny_room, tmp_path_factory.mktemp("long") / "room", repeats=40)


def start(room: Path, folder: Path) -> subprocess.Popen[str]:
    """Start a run and wait until a few frames are on disk."""
    arguments = command("run", room, "--depth", "sensor", "--output", folder, "--no-mesh")
    process = subprocess.Popen(
        arguments, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    online = folder / "trajectory_online.txt"
    deadline_s = time.monotonic() + PATIENCE_S
    while not (online.exists() and online.read_text().count("\n") > 6):
        if process.poll() is not None or time.monotonic() > deadline_s:
            process.kill()
            pytest.fail(f"the run did not start: {process.communicate()[1]}")
        time.sleep(0.01)
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_run_with_what_it_has(
    number: signal.Signals, long_room: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    process = start(long_room, folder)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    report = json.loads((folder / "report.json").read_text())
    total = 40 * 78
    assert f"interrupted after {report['frames']} of {total} frames" in report["notes"]
    assert report["options"]["interrupted"] is True
    assert "interrupted after" in stdout
    trajectory, _ = read_tum_trajectory(folder / "trajectory.txt")
    assert 6 <= len(trajectory) == report["tracked"] < total


def test_after_a_kill_the_online_trajectory_is_readable(long_room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start(long_room, folder)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    online, notes = read_tum_trajectory(folder / "trajectory_online.txt")
    assert len(online) >= 6
    assert notes == []
    assert np.isfinite(online.T_world_camera).all()
    assert (folder / "config.yaml").exists()
    assert "frames" in (folder / "log.txt").read_text()
    assert not (folder / "trajectory.txt").exists()


def test_an_interrupted_rendering_says_that_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render, frames = sequence.render_frame, []

    def interrupted_at_the_fourth(*arguments: Any) -> Any:
        frames.append(arguments)
        if len(frames) == 4:
            signal.raise_signal(signal.SIGINT)
        return render(*arguments)

    monkeypatch.setattr(sequence, "render_frame", interrupted_at_the_fourth)
    out = tmp_path / "room"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    try:
        done = call("synth", out, "--frames", 8, "--width", 64, "--height", 48)
    finally:
        signal.signal(signal.SIGINT, before)
    message = f"error: interrupted: 3 of 8 frames are kept in {out}; the same command goes on\n"
    assert (done.returncode, done.stderr) == (130, message)
    assert len(list(out.glob("rgb/*.png"))) == 3
    assert call("synth", out, "--frames", 8, "--width", 64, "--height", 48).returncode == 0
    assert len(frames) == 4 + 5
