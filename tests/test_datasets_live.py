# SPDX-License-Identifier: Apache-2.0
"""Live sources: frames that come too fast are left out and counted, and a source may stall or end."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import encoded
from command_line import call
from sequences import imread
from streams import Stream, serving
from tracking_scene import register_constant_depth

from slamdepth.datasets import Dataset, ReadOptions, open_dataset
from slamdepth.datasets.addresses import address_of, without_secret
from slamdepth.datasets.intrinsics import Certainty
from slamdepth.errors import ConfigError, DatasetError, ImageDecodeError, SourceEnded
from slamdepth.pipeline.run import run
from slamdepth.types import Frame


def numbered(count: int) -> list[bytes]:
    """JPEGs whose grey value is their number."""
    return [encoded(np.full((48, 64, 3), number, np.uint8), ".jpg") for number in range(count)]


def room_frames(tiny_room: Path) -> list[bytes]:
    return [encoded(imread(path), ".jpg") for path in sorted((tiny_room / "rgb").iterdir())]


@pytest.fixture(scope="module", autouse=True)
def constant_depth() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        register_constant_depth(monkeypatch)
        yield


def read_all(dataset: Dataset, pause_s: float = 0.0) -> tuple[list[Frame], str]:
    """Every frame until the source ends, and why it did."""
    frames: list[Frame] = []
    try:
        for index in range(1000):
            frames.append(dataset.read(index))
            time.sleep(pause_s)
    except SourceEnded as error:
        return frames, str(error)
    raise AssertionError("the source did not end")


def test_a_slow_reader_gets_the_newest_frame_and_late_ones_are_counted() -> None:
    with serving(Stream(numbered(60), 30.0)) as address:
        dataset = open_dataset(f"{address}/video")
        assert dataset.is_live
        assert dataset.layout == "live"
        assert dataset.camera_source.certainty is Certainty.GUESSED
        frames, why = read_all(dataset, 0.15)
        notes = dataset.close()
    assert why.endswith("the source ended")
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert len(dataset) == len(frames) == len(dataset.timestamps_s)
    assert (np.diff(dataset.timestamps_s) > 0).all()
    seen = [round(float(frame.image_rgb.mean())) for frame in frames]
    assert (np.diff(seen) >= 1).all()
    assert 8 <= len(seen) <= 30
    (note,) = notes
    assert abs(int(note.split()[0]) + len(seen) - 60) <= 3
    with pytest.raises(ImageDecodeError, match="is not kept"):
        dataset.read(0)


def test_a_reader_that_keeps_up_loses_next_to_nothing() -> None:
    with serving(Stream(numbered(20), 10.0)) as address:
        dataset = open_dataset(address)
        frames, _ = read_all(dataset)
        dataset.close()
    assert len(frames) >= 16  # all, unless this machine pauses for a tenth of a second


def test_a_source_that_stalls_ends_in_one_line_and_in_time() -> None:
    with serving(Stream(numbered(5), 30.0, stall=True)) as address:
        dataset = open_dataset(address, options=ReadOptions(stall_s=1.0))
        start_s = time.monotonic()
        _, why = read_all(dataset)
        assert "no frame for 1 s: the source stalled" in why or "the source ended" in why
        assert time.monotonic() - start_s < 6.0
        dataset.close()


def test_seconds_end_a_live_source() -> None:
    with serving(Stream(numbered(200), 30.0)) as address:
        dataset = open_dataset(address, options=ReadOptions(seconds=1.0))
        _, why = read_all(dataset)
        assert why.endswith("stopped after 1 s")
        assert dataset.timestamps_s[-1] <= 1.0
        dataset.close()
    with pytest.raises(ConfigError, match="--seconds must be positive"):
        ReadOptions(seconds=0.0)


def test_a_video_file_behind_an_address_plays_at_its_own_speed(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (64, 48))
    for number in range(30):
        writer.write(np.full((48, 64, 3), 8 * number, np.uint8))
    writer.release()
    with serving(path) as address:
        start_s = time.monotonic()
        dataset = open_dataset(f"{address}/walk.mp4")
        frames, _ = read_all(dataset)
        assert time.monotonic() - start_s > 1.0
        assert len(frames) >= 25
        assert dataset.timestamps_s[-1] == pytest.approx(1.45, abs=0.2)
        dataset.close()


@pytest.mark.parametrize(
    ("source", "message"),
    [("camera:99", "camera:99: cannot be opened"), ("http://127.0.0.1:9/nothing", "cannot be opened")],
)
def test_a_source_that_is_not_there_is_one_line(source: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        open_dataset(source, options=ReadOptions(stall_s=2.0))
    assert "\n" not in str(caught.value)


def test_addresses_survive_being_paths_and_are_shown_without_secrets() -> None:
    secret = "rtsp://admin:pass@10.0.0.7:554/stream?token=abc"
    assert address_of(str(Path(secret))) == secret
    assert without_secret(secret) == "rtsp://10.0.0.7:554/stream"
    assert without_secret("walk.mp4") == "walk.mp4"


def test_a_run_over_a_stream_is_finished_when_it_ends(tiny_room: Path, tmp_path: Path) -> None:
    with serving(Stream(room_frames(tiny_room), 8.0)) as address:
        done = call(
            "run", f"{address}/video?key=secret", "--camera", tiny_room / "camera.yaml", "--depth",
            "constant", "--no-mesh", "-o", tmp_path / "run",
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert any("the source ended" in note for note in report["notes"])
    assert len((tmp_path / "run" / "trajectory.txt").read_text().splitlines()) >= 10
    for path in (tmp_path / "run").glob("*.*"):
        assert b"secret" not in path.read_bytes(), path


def test_info_of_a_stream(tiny_room: Path) -> None:
    with serving(Stream(room_frames(tiny_room), 20.0)) as address:
        told = json.loads(call("info", address, "--json").stdout)
    assert told["live"] is True
    assert told["frames"] is None
    assert 10 < told["rate_hz"] < 40
    assert (told["width"], told["height"]) == (320, 240)


def test_a_live_run_that_is_stopped_is_finished(tiny_room: Path, tmp_path: Path) -> None:
    """Ctrl-C sets this event."""
    frames, stop = room_frames(tiny_room), threading.Event()
    with serving(Stream((frames + frames[::-1]) * 40, 10.0)) as address:
        result = run(
            address,
            tmp_path / "run",
            depth="constant",
            camera=tiny_room / "camera.yaml",
            mesh=False,
            progress=lambda state: stop.set() if state.done >= 15 else None,
            stop=stop,
        )
    assert len(result.trajectory) >= 10
    assert any(note.startswith("stopped after ") for note in result.summary["notes"])


def test_max_frames_end_a_live_run_that_would_go_on(tiny_room: Path, tmp_path: Path) -> None:
    frames = room_frames(tiny_room)
    with serving(Stream((frames + frames[::-1]) * 40, 30.0)) as address:
        done = call(
            "run", address, "--camera", tiny_room / "camera.yaml", "--depth", "constant", "--no-mesh", "-o",
            tmp_path / "run", "--max-frames", 12,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["options"]["interrupted"] is False


def test_images_of_another_size_in_a_stream_are_left_out() -> None:
    sent = numbered(10)
    sent[4] = encoded(np.zeros((24, 32, 3), np.uint8), ".jpg")
    with serving(Stream(sent, 20.0)) as address:
        dataset = open_dataset(address)
        frames, _ = read_all(dataset)
        dataset.close()
    assert {frame.image_rgb.shape for frame in frames} == {(48, 64, 3)}
