# SPDX-License-Identifier: Apache-2.0
"""Runs that are killed go on from their last checkpoint, and end as if nothing had happened."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ENVIRONMENT, call, command, leave_out_plots, make_long
from saved_walk import tracked
from tracking_scene import CAMERA, CONFIG, COUNT, ConstantDepth, colour_only, frames, walk

from slamdepth import Config, DepthPrediction, Frame, Session, StoredFrame, Tracker
from slamdepth.depth.base import DepthModel
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import OutputError
from slamdepth.io.tensors import decode_tensors, encode_tensors
from slamdepth.io.tree import flattened, restored
from slamdepth.mapping.keyframe_store import StoredPrediction
from slamdepth.pipeline import checkpoint
from slamdepth.pipeline.asked import begun_run
from slamdepth.pipeline.options import RunOptions
from slamdepth.pipeline.steps import steps_of, steps_state
from slamdepth.types import StepResult

PATIENCE_S = 600.0


def read_frame(index: int) -> Frame:
    return walk()[0][index]


def with_little_memory() -> Config:
    """Settings with which all but the newest keyframes are spilled."""
    map_ = CONFIG.map.model_copy(update={"keyframe_memory_mib": 0.0})
    return CONFIG.model_copy(update={"map": map_})


def as_kept(prediction: DepthPrediction) -> DepthPrediction:
    """What a checkpoint has of a prediction."""
    sigma: Any = None if prediction.is_sensor else np.asarray(prediction.sigma_log, np.float16)
    return StoredPrediction(replace(prediction, sigma_log=sigma)).load()


@pytest.mark.parametrize(("model", "change"), [(SensorDepth, None), (ConstantDepth, colour_only)])
def test_a_restored_tracker_goes_on_as_the_first_one_would_have(
    model: Callable[[], DepthModel], change: Callable[[Frame], Frame] | None
) -> None:
    given = frames(range(COUNT), change)
    config = with_little_memory()
    first = Tracker(CAMERA, model(), config)
    saved: list[tuple[int, bytes]] = []
    steps: list[StepResult] = []
    for n, frame in enumerate(given):
        steps.append(first.step(frame))
        if n > 10 and n >= (saved[-1][0] + 15 if saved else 0) and first.is_quiet:
            plain, arrays = flattened(first.state())
            saved.append((n + 1, encode_tensors(arrays, {"tree": plain})))
    assert len(saved) >= 2
    ended = first.finish()

    def predict(frame: StoredFrame) -> DepthPrediction:
        return as_kept(model().predict(frame.load()))

    for done, data in saved:
        second = Tracker(CAMERA, model(), config)
        arrays, about = decode_tensors(data)
        second.restore(restored(about["tree"], arrays), read_frame, predict)
        for frame, before in zip(given[done:], steps[done:], strict=True):
            after = second.step(frame)
            assert (after.status, after.inliers, after.is_keyframe) == (
                before.status,
                before.inliers,
                before.is_keyframe,
            )
            np.testing.assert_array_equal(after.T_world_camera, before.T_world_camera)
        again = second.finish()
        np.testing.assert_array_equal(again.trajectory.T_world_camera, ended.trajectory.T_world_camera)
        np.testing.assert_array_equal(again.points_m, ended.points_m)
        assert again.statistics.loop_closures == ended.statistics.loop_closures
        assert again.statistics.readout_s == ended.statistics.readout_s
        for one, other in zip(ended.keyframes, again.keyframes, strict=True):
            np.testing.assert_array_equal(one.frame.load().image_rgb, other.frame.load().image_rgb)
            np.testing.assert_array_equal(one.load_depth_m(), other.load_depth_m())


def test_a_tracker_restored_in_a_map_with_images_has_them_still() -> None:
    begun = tracked(frames(range(16)), with_images=True)[2]
    given = frames(range(12, COUNT))
    first = Tracker(CAMERA, SensorDepth(), CONFIG, start_map=begun)
    saved: tuple[int, bytes] | None = None
    for n, frame in enumerate(given):
        first.step(frame)
        if saved is None and n > 10 and first.is_quiet:
            plain, arrays = flattened(first.state())
            saved = n + 1, encode_tensors(arrays, {"tree": plain})
    assert saved is not None
    done, data = saved
    second = Tracker(CAMERA, SensorDepth(), CONFIG, start_map=begun)
    arrays, about = decode_tensors(data)
    second.restore(
        restored(about["tree"], arrays), read_frame, lambda frame: SensorDepth().predict(frame.load())
    )
    for frame in given[done:]:
        second.step(frame)
    one, other = (
        tracker.saved_map(0, tracker.finish(), Session("walk", "sensor"), {}, with_images=True)
        for tracker in (first, second)
    )
    assert (one.groups["keyframes"]["session"] == 0).any()
    for name, array in one.groups["images"].items():
        np.testing.assert_array_equal(other.groups["images"][name], array)


def test_a_waiting_keyframe_keeps_its_words_where_they_are_not_its_descriptors() -> None:
    config = Config.from_dict({"features": {"name": "sift", "count": 400}})
    given = frames(range(40), colour_only)
    first = Tracker(CAMERA, ConstantDepth(), config)
    saved: tuple[int, bytes] | None = None
    for n, frame in enumerate(given):
        first.step(frame)
        if saved is None and n > 10 and first.is_quiet:
            state = first.state()
            if state["atlas"]["maps"][0]["integration"]["waiting"]:
                plain, arrays = flattened(state)
                saved = n + 1, encode_tensors(arrays, {"tree": plain})
    assert saved is not None
    done, data = saved
    second = Tracker(CAMERA, ConstantDepth(), config)
    arrays, about = decode_tensors(data)
    second.restore(
        restored(about["tree"], arrays), read_frame, lambda frame: ConstantDepth().predict(frame.load())
    )
    for frame in given[done:]:
        second.step(frame)
    np.testing.assert_array_equal(
        second.finish().trajectory.T_world_camera, first.finish().trajectory.T_world_camera
    )


def test_results_of_frames_come_back_from_arrays() -> None:
    tracker = Tracker(CAMERA, SensorDepth(), CONFIG)
    steps = [tracker.step(frame) for frame in frames(range(6))]
    tracker.close()
    plain, arrays = flattened(steps_state(steps))
    for before, after in zip(steps, steps_of(restored(json.loads(json.dumps(plain)), arrays)), strict=True):
        assert before.status is after.status
        assert before.timings_ms == after.timings_ms
        assert (before.index, before.inliers, before.quality) == (after.index, after.inliers, after.quality)
        np.testing.assert_array_equal(before.T_world_camera, after.T_world_camera)
        np.testing.assert_array_equal(before.covariance, after.covariance)
    assert steps_of(steps_state([])) == ()


@pytest.fixture(scope="module")
def room(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_long(tiny_room, tmp_path_factory.mktemp("long") / "room", repeats=3)


def arguments(room: Path, folder: Path, every_s: float) -> list[object]:
    options = ("--depth", "sensor", "--no-mesh", "--checkpoint-every", every_s)
    return ["run", room, "--output", folder, *options]


def kill_at(room: Path, folder: Path, is_there: Callable[[], bool]) -> None:
    """Start a run with frequent checkpoints and kill it as soon as something is there."""
    process = subprocess.Popen(
        command(*arguments(room, folder, 0.05)), env=ENVIRONMENT, stdout=subprocess.DEVNULL
    )
    deadline_s = time.monotonic() + PATIENCE_S
    while not is_there():
        assert process.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    process.kill()
    process.wait()


def test_a_killed_run_ends_with_the_same_bytes(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    assert call(*arguments(room, whole, 0)).returncode == 0
    kill_at(room, killed, (killed / "checkpoint" / "latest.json").exists)
    assert not (killed / "report.json").exists()
    done = call("run", "--resume", killed)
    assert done.returncode == 0, done.stderr
    reports = [json.loads((folder / "report.json").read_text()) for folder in (killed, whole)]
    assert [report["frames"] for report in reports] == [3 * 78, 3 * 78]  # nobody stopped either of them
    for name in ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "map/keyframes.safetensors"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
    assert not (killed / "checkpoint").exists()
    assert "going on from the checkpoint" in (killed / "log.txt").read_text()
    again = call("run", "--resume", killed)
    assert (again.returncode, "is finished" in again.stdout) == (0, True)


def test_a_run_killed_before_its_first_checkpoint_starts_again(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    folder = tmp_path / "run"
    kill_at(room, folder, (folder / "checkpoint" / "run.json").exists)
    for file in (folder / "checkpoint").glob("latest.json"):
        file.unlink()
    done = call("run", "--resume", folder)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "report.json").read_text())["frames"] == 3 * 78


@pytest.mark.parametrize(
    "given", [("--max-frames", 5), ("--output", "elsewhere"), ("--no-mesh",), ("--seed", 0), ("--view",)]
)
def test_options_that_a_resumed_run_would_not_heed_are_refused(
    tmp_path: Path, given: tuple[object, ...]
) -> None:
    done = call("run", "--resume", tmp_path, *given)
    assert done.returncode == 2
    assert f"the options that the run had: leave out {given[0]}" in done.stderr
    assert "holds no run" in call("run", "--resume", tmp_path, "--quiet").stderr


def test_a_run_goes_on_from_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "imu.csv").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    config = Config.from_dict({"scale": {"imu": "imu.csv"}})
    begun = begun_run(RunOptions(Path("img_*.png"), camera_file=Path("~/cam.yaml")), config, {})
    assert begun["config"]["scale"]["imu"] == str(tmp_path / "imu.csv")
    assert begun["options"]["sequence"] == str(tmp_path / "img_*.png")
    assert begun["options"]["camera_file"] == str(tmp_path / "home" / "cam.yaml")
    assert Config.from_dict(begun["config"]).scale.depth is None


def test_what_cannot_go_on_is_said_in_one_line(room: Path, tiny_room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    kill_at(room, folder, (folder / "checkpoint" / "latest.json").exists)

    def refused(*given: object) -> str:
        done = call("run", "--resume", *given)
        assert done.returncode == 2, done.stdout
        assert done.stderr.count("\n") == 1
        return done.stderr

    assert "holds no run" in refused(tmp_path)
    assert "is not the sequence" in refused(folder, tiny_room)
    state = next((folder / "checkpoint").glob("state-*.safetensors"))
    data = bytearray(state.read_bytes())
    data[-5] ^= 1
    state.write_bytes(bytes(data))
    assert f"{state.name}: is damaged" in refused(folder)
    latest = folder / "checkpoint" / "latest.json"
    latest.write_text(json.dumps({**json.loads(latest.read_text()), "version": 99}))
    assert "has version 99" in refused(folder)


def test_where_the_disk_is_full_the_run_goes_on_without_checkpoints(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)

    def full(path: Path, data: bytes) -> str:
        raise OutputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(checkpoint, "write_bytes", full)
    done = call(*arguments(tiny_room, tmp_path / "run", 0.01))
    assert done.returncode == 0, done.stderr
    assert "no more checkpoints are written, the run goes on" in (tmp_path / "run" / "log.txt").read_text()
