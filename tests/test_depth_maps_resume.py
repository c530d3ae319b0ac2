# SPDX-License-Identifier: Apache-2.0
"""Depth maps: going on after a stop, other settings, little disk space."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import ENVIRONMENT, command, make_long
from depth_map_models import INVERSE, METRIC, SEEN, files, make, photos, register_ramps, video
from sequences import image_rgb, make_tum, write_image

from slamdepth.errors import ConfigError, OutputError
from slamdepth.pipeline.depth_maps import DepthMapOptions, DepthMapsInterrupted, make_depth_maps


@pytest.fixture(autouse=True)
def models(monkeypatch: pytest.MonkeyPatch) -> None:
    register_ramps(monkeypatch)


def test_only_what_is_missing_is_predicted_again(tmp_path: Path) -> None:
    folder, out = photos(tmp_path / "in", 4), tmp_path / "out"
    make(folder, out)
    before = {name: (out / name).read_bytes() for name in files(out)}
    SEEN.clear()
    make(folder, out)
    assert SEEN == []
    assert {name: (out / name).read_bytes() for name in files(out)} == before
    (out / "cloud" / "p9.cloud.ply").unlink()
    write_image(folder / "p10.png", image_rgb(7))
    make(folder, out)
    assert SEEN == [1, 2]
    assert np.load(out / "depth-metres" / "p10.depth-metres.npy").shape == (12, 16)


@pytest.mark.parametrize("after", [1, 4, 8])
def test_a_stopped_video_goes_on_to_the_same_bytes(after: int, tmp_path: Path) -> None:
    """Stopped while predicting, between the passes, and while drawing."""
    source = video(tmp_path / "v.mp4")
    make(source, tmp_path / "whole")
    stop, calls = threading.Event(), []

    def count(*state: object) -> None:
        calls.append(state)
        if len(calls) == after:
            stop.set()

    out = tmp_path / "out"
    options = DepthMapOptions(source, out, METRIC)
    with pytest.raises(DepthMapsInterrupted, match="the same command goes on") as stopped:
        make_depth_maps(options, progress=count, stop=stop)
    assert stopped.value.exit_code == 130
    assert json.loads((out / "depth.json").read_text())["complete"] is False
    done = min(after, 6)
    with (out / "frames.jsonl").open("a") as journal:
        journal.write('{"name": "frame-0000')  # as a kill leaves it
    SEEN.clear()
    assert make_depth_maps(options).about["complete"] is True
    assert list(range(done, 6)) == SEEN
    for name in files(tmp_path / "whole"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def test_more_frames_of_a_video_can_be_asked_for_later(tmp_path: Path) -> None:
    source = video(tmp_path / "v.mp4")
    make(source, tmp_path / "out", max_frames=2)
    SEEN.clear()
    assert make(source, tmp_path / "out")["video"]["frames"] == 6
    assert SEEN == [2, 3, 4, 5]


def test_other_settings_need_overwrite(tmp_path: Path) -> None:
    folder, out = photos(tmp_path / "in"), tmp_path / "out"
    make(folder, out)
    (out / "mine.txt").write_text("kept")
    with pytest.raises(ConfigError, match=r"made with 'point clouds' true, now false; .*--overwrite"):
        make(folder, out, cloud=False)
    with pytest.raises(ConfigError, match="made with 'depth model' ramp metric depth, now ramp affine inv"):
        make(folder, out, INVERSE)
    make(folder, out, INVERSE, overwrite=True)
    assert not (out / "cloud").exists()
    assert not list(out.rglob("*metres*"))
    assert (out / "mine.txt").read_text() == "kept"


def test_another_sequence_of_the_same_name_is_another(tmp_path: Path) -> None:
    """All of 7-Scenes are called seq-NN."""
    chess, fire = (tmp_path / scene / "seq-01" for scene in ("chess", "fire"))
    out = tmp_path / "out"
    make(make_tum(chess, 3), out, "sensor")
    with pytest.raises(ConfigError, match=r"made with 'source' .*seq-01 \(.*now .*seq-01 \(.*--overwrite"):
        make(make_tum(fire, 4), out, "sensor")
    assert make(chess, out, "sensor")["frames"] == 3


def test_a_full_disk_is_reported_after_the_first_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from types import SimpleNamespace

    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(OutputError, match="GB free; leave out the point clouds"):
        make(photos(tmp_path / "in"), tmp_path / "out")
    assert SEEN == [0]


@pytest.mark.parametrize(
    ("cloud", "said"), [(True, r"--no-cloud leaves out \d\d% of that"), (False, "--stride and --max-frames")]
)
def test_many_gigabytes_are_reported_after_the_first_image(
    cloud: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    source = photos(tmp_path / "in")
    make(source, tmp_path / "small", cloud=cloud)
    assert "GB" not in caplog.text
    monkeypatch.setattr("slamdepth.pipeline.depth_maps.job._MUCH_BYTES", 1000)
    about = make(source, tmp_path / "large", cloud=cloud)
    (warning,) = [record.getMessage() for record in caplog.records if "GB" in record.getMessage()]
    assert re.fullmatch(
        rf"{about['frames'] - 1} images? still to do, about .* GB, .* GB free; {said}.*", warning
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_is_one_line_and_code_130(number: signal.Signals, tiny_room: Path, tmp_path: Path) -> None:
    room, out = make_long(tiny_room, tmp_path / "room", repeats=40), tmp_path / "out"
    process = subprocess.Popen(
        command("depth", room, "--depth", "sensor", "--output", out, "--no-cloud", "--quiet"),
        env=ENVIRONMENT,
        stderr=subprocess.PIPE,
        text=True,
    )
    journal = out / "frames.jsonl"
    while process.poll() is None and not (journal.exists() and journal.read_text().count("\n") > 3):
        time.sleep(0.01)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=600)
    assert process.returncode == 130, stderr
    assert stderr.startswith("error: interrupted while predicting: ")
    assert stderr.count("\n") == 1
    done = [json.loads(line)["name"] for line in journal.read_text().splitlines()]
    assert len(list((out / "depth-metres").glob("*.npy"))) == len(done) > 3
