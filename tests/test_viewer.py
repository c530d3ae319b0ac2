# SPDX-License-Identifier: Apache-2.0
"""The viewer: a finished run, a run that goes on, and the command, with and without a browser."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from command_line import ENVIRONMENT, call, command, slamdepth
from scene_data import RED, several_maps_with_scene, write_run
from test_report_browser import share_of
from tracking_scene import CAMERA, CONFIG, frames

from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.report.saved_run import SavedRun, read_run
from slamdepth.tracking import create_tracker
from slamdepth.tracking.snapshot import MapSnapshot
from slamdepth.viewer import LiveView, RunView, address_of, start_server, stop_server
from slamdepth.viewer.server import frustum_lines


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "first")


@pytest.fixture
def server() -> Iterator[Any]:
    pytest.importorskip("viser", reason="viser is not installed")
    started = start_server(port=0)
    yield started
    stop_server(started)


def becomes(share: Callable[[], float], least: float) -> bool:
    """Whether a share of the window reaches ``least`` within a minute."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if share() > least:
            return True
        time.sleep(0.3)
    return False


def share_of_path(page: Page) -> float:
    """Share of pixels as blue as the path, which viser draws a little paler."""
    red, _, blue = np.moveaxis(page.picture().astype(int), 2, 0)
    return float(np.mean((blue > 150) & (red < 90)))


def test_a_run_is_shown_in_the_browser_and_nothing_leaves_the_machine(server: Any, run_folder: Path) -> None:
    view = RunView(server, read_run(run_folder).with_meshes())
    with browser() as page:
        page.size(1000, 700)
        page.open(address_of(server))
        assert becomes(lambda: share_of(page.picture(), RED), 0.02)
        assert all(address.startswith("http://127.0.0.1:") for address in page.requests)
        page.wait_for("document.body.innerText.includes('keyframe 0')")
        view._slider.value = 4
        page.wait_for("document.body.innerText.includes('keyframe 4')")
        view._boxes["mesh"].value = False
        view._update_parts()
        time.sleep(1.0)
        assert share_of(page.picture(), RED) < 0.005
    view.close()


def test_maps_are_shown_one_at_a_time(server: Any, tmp_path: Path) -> None:
    data = several_maps_with_scene()
    assert data.scene is not None
    summary = {"sequence": "hall", "health": {"headline": "Reliable."}}
    view = RunView(server, SavedRun(tmp_path, summary, data.scene))
    shown = {key for key, handle in view._parts.items() if handle.visible}
    assert shown == {"0 mesh", "0 path", "0 keyframes"}
    second = next(n for n, stop in enumerate(view._stops) if stop.map_index == 1)
    view.show(second)
    assert {key for key, handle in view._parts.items() if handle.visible} == {"1 path", "1 keyframes"}
    assert view._chooser.value.startswith("map 2")
    view.close()


def test_the_playback_goes_on_by_itself(server: Any, run_folder: Path) -> None:
    view = RunView(server, read_run(run_folder))
    view._speed.value = 20
    view._playing.value = True
    end = time.monotonic() + 20
    while view._slider.value < 3:
        assert time.monotonic() < end
        time.sleep(0.02)
    view.close()


def test_only_this_machine_reaches_it_unless_asked(server: Any) -> None:
    assert server.get_host() == "127.0.0.1"
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", address_of(server))


def test_a_taken_port_and_a_missing_viser_are_said_in_one_line(
    server: Any, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="cannot be opened"):
        start_server(port=server.get_port())
    with pytest.raises(ConfigError, match="0 to 65535"):
        start_server(port=70000)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SlamdepthError, match=r"pip install 'slamdepth\[viewer\]'"):
        start_server(port=0)
    done = call("view", run_folder)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


def test_the_command_prints_its_address_serves_a_page_and_ends_on_ctrl_c(run_folder: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    process = subprocess.Popen(
        command("view", run_folder, "--port", 0),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    found = re.match(r"viewer: (http://127\.0\.0\.1:\d+) ", line)
    assert found is not None, line
    with urllib.request.urlopen(found[1], timeout=20) as answer:
        assert answer.status == 200
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert errors == ""


def test_frustums_end_at_the_corners_of_the_image() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 2.0, 3.0]
    lines = frustum_lines(pose[None], (0.5, 0.25), 2.0)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.tile([1.0, 2.0, 3.0], (4, 1)))
    np.testing.assert_allclose(lines[0, 1], [0.0, 1.5, 5.0])


def test_snapshots_are_copies_and_leave_the_tracker_as_it_is() -> None:
    alone, watched = (create_tracker(CAMERA, SensorDepth(), CONFIG) for _ in range(2))
    taken: list[MapSnapshot] = []
    with alone, watched:
        for frame in frames(range(0, 40)):
            a = alone.step(frame)
            watched.ask_for_snapshot()
            b = watched.step(frame)
            snapshot = watched.take_snapshot()
            assert watched.take_snapshot() is None
            assert a.T_world_camera is not None
            assert b.T_world_camera is not None
            assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
            if snapshot is not None:
                taken.append(snapshot)
                snapshot.points_m[:] = 0.0  # its own
                snapshot.T_world_camera[:] = 0.0
        results = [tracker.finish().trajectory.T_world_camera for tracker in (alone, watched)]
    assert results[0].tobytes() == results[1].tobytes()
    assert len(taken) == 40
    assert len(taken[-1].timestamps_s) == len(taken[-1].T_world_camera) > 1
    assert len(taken[-1].points_m) > 100


class FakeTracker:
    """Gives a snapshot of one keyframe for each request."""

    def __init__(self) -> None:
        self.asked = 0
        self._is_asked = False

    def ask_for_snapshot(self) -> None:
        self.asked += 1
        self._is_asked = True

    def take_snapshot(self) -> MapSnapshot | None:
        if not self._is_asked:
            return None
        self._is_asked = False
        points = np.random.default_rng(0).normal(size=(50, 3))
        return MapSnapshot(0, np.zeros(1), np.eye(4)[None], points, np.zeros((0, 2), np.int64))


def fake_result(n: int) -> Any:
    return SimpleNamespace(
        T_world_camera=np.eye(4), map_id=0, index=n, keyframes=1, loop_closures=0,
        status=SimpleNamespace(value="tracking"),
    )  # fmt: skip


def test_nothing_is_copied_while_nobody_looks(server: Any) -> None:
    tracker, frame = FakeTracker(), frames([0])[0]
    with LiveView(server) as view:
        for n in range(50):
            view.saw(frame, fake_result(n), tracker)
        assert tracker.asked == 0
        view._is_wanted.set()
        for n in range(50):
            view.saw(frame, fake_result(n), tracker)
        assert tracker.asked == 1


def test_a_slow_browser_holds_up_no_frame(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, frame = FakeTracker(), frames([0])[0]
    drawing = threading.Event()

    def slow(news: object) -> None:
        drawing.set()
        time.sleep(1.0)

    with LiveView(server) as view:
        monkeypatch.setattr(view, "_draw", slow)
        view._is_wanted.set()
        for n in range(3):
            view.saw(frame, fake_result(n), tracker)
        assert drawing.wait(20)
        view._is_wanted.set()
        start = time.perf_counter()
        for n in range(200):
            view.saw(frame, fake_result(n), tracker)
        assert time.perf_counter() - start < 0.5


def test_a_run_that_goes_on_is_shown(server: Any) -> None:
    with browser() as page, LiveView(server) as view:
        page.size(900, 600)
        page.open(address_of(server))
        page.wait_for("document.body.innerText.includes('waiting for the first keyframe')")
        with create_tracker(CAMERA, SensorDepth(), CONFIG) as tracker:
            for frame in frames():
                view.saw(frame, tracker.step(frame), tracker)
                time.sleep(0.02)
        page.wait_for("document.body.innerText.includes('keyframes')")
        assert becomes(lambda: share_of_path(page), 0.0005)


def test_a_run_with_a_viewer_gives_the_same_files_and_says_its_address(
    tiny_room: Path, tmp_path: Path
) -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    asked = ("run", tiny_room, "--depth", "sensor", "--max-frames", 12, "--no-mesh", "--output")
    alone = slamdepth(*asked, tmp_path / "alone")
    watched = slamdepth(*asked, tmp_path / "watched", "--view", "--port", 0)
    assert (alone.returncode, watched.returncode) == (0, 0), watched.stderr
    assert re.search(r"^viewer: http://127\.0\.0\.1:\d+$", watched.stderr, re.MULTILINE)
    assert "viser" not in watched.stdout + watched.stderr
    for name in ("trajectory.txt", "trajectory_online.txt", "keyframes.txt"):
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "watched" / name).read_bytes()
