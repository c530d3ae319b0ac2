# SPDX-License-Identifier: Apache-2.0
"""Batches: many recordings, each in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, call, command, make_long, slamdepth

from slamdepth.errors import ConfigError, DatasetError, OutputError
from slamdepth.pipeline.asked import arguments_of
from slamdepth.pipeline.batch import BatchProgress, Recording, find_recordings, run_batch
from slamdepth.pipeline.batch.job import Job, State, failure, share_cores
from slamdepth.pipeline.batch.run import _job
from slamdepth.pipeline.checkpoint import begin
from slamdepth.pipeline.options import RunOptions

PATIENCE_S = 300.0
QUICK = "--depth sensor --no-mesh --max-frames 4"

# Stands for 'slamdepth run INPUT ... --output FOLDER'; the name of the recording says what happens.
PRETEND = """
import json, os, pathlib, signal, sys, time
name, folder = sys.argv[2], pathlib.Path(sys.argv[sys.argv.index("--output") + 1])
if "bad" in name:
    print("error: " + name + ": no such folder", file=sys.stderr)
    sys.exit(2)
if "killed" in name:
    os.kill(os.getpid(), signal.SIGKILL)
folder.mkdir(parents=True, exist_ok=True)
with (folder / "starts").open("a") as file:
    file.write(os.environ.get("OMP_NUM_THREADS", "any") + chr(10))
if "slow" in name:
    time.sleep(60)
report = {"health": {"verdict": "good"}, "frames": 4, "options": {"interrupted": False}}
(folder / "report.json").write_text(json.dumps(report))
"""


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs take no time."""

    def commanded(job: Job) -> list[str]:
        return [sys.executable, "-c", PRETEND, "run", *job.arguments, "--output", str(job.folder)]

    monkeypatch.setattr(Job, "command", commanded)


def recordings(*names: str) -> list[Recording]:
    return [Recording(name) for name in names]


@pytest.mark.usefixtures("pretend")
def test_a_failing_recording_stops_no_other(tmp_path: Path) -> None:
    seen: list[BatchProgress] = []
    content = run_batch(
        recordings("one", "bad", "killed", "two"), tmp_path / "b", jobs=2, progress=seen.append
    )
    states = {run["name"]: run["state"] for run in content["runs"]}
    assert states == {"one": "done", "bad": "failed", "killed": "failed", "two": "done"}
    errors = {run["name"]: run["error"] for run in content["runs"] if run["error"]}
    assert errors == {"bad": "bad: no such folder", "killed": "ended by SIGKILL: out of memory?"}
    assert content["counts"]["done"] == 2
    assert json.loads((tmp_path / "b" / "batch.json").read_text()) == content
    page = (tmp_path / "b" / "batch.html").read_text()
    assert 'href="one/report.html"' in page
    assert "bad: no such folder" in page
    assert max(state.ended for state in seen) == seen[-1].total == 4


@pytest.mark.usefixtures("pretend")
def test_a_batch_goes_on_where_it_stopped(tmp_path: Path) -> None:
    run_batch(recordings("one", "bad"), tmp_path / "b", options=("--seed", "1"))
    again = run_batch(recordings("one", "bad", "three"), tmp_path / "b", options=("--seed", "1"))
    assert again["not_repeated"] == ["one"]
    assert (tmp_path / "b" / "one" / "starts").read_text().count("\n") == 1
    assert [run["state"] for run in again["runs"]] == ["done", "failed", "done"]


@pytest.mark.usefixtures("pretend")
def test_other_options_run_it_again(tmp_path: Path) -> None:
    run_batch(recordings("one"), tmp_path / "b")
    run_batch(recordings("one"), tmp_path / "b", options=("--seed", "2"))
    assert (tmp_path / "b" / "one" / "starts").read_text().count("\n") == 2


@pytest.mark.usefixtures("pretend")
def test_a_run_without_its_report_is_done_again(tmp_path: Path) -> None:
    run_batch(recordings("one", "two"), tmp_path / "b")
    (tmp_path / "b" / "one" / "report.json").unlink()
    again = run_batch(recordings("one", "two"), tmp_path / "b")
    assert again["not_repeated"] == ["two"]
    assert again["counts"]["done"] == 2


def test_a_half_run_goes_on_and_a_failed_one_does_not(tmp_path: Path) -> None:
    def command_of(state: str, arguments: tuple[str, ...] = ("one",)) -> list[str]:
        return _job("one", arguments, tmp_path, {"arguments": ["one"], "state": state}).command()

    (tmp_path / "one").mkdir()
    assert "--overwrite" in command_of("waiting")  # nothing to go on with
    begin(tmp_path / "one", {})
    goes_on = ["run", "--resume", str(tmp_path / "one")]
    assert command_of("waiting")[-3:] == command_of("stopped")[-3:] == goes_on
    assert "--overwrite" in command_of("failed")
    assert "--overwrite" in command_of("stopped", ("one", "--seed", "2"))


def test_a_recording_whose_name_begins_with_a_dash_is_no_option(tmp_path: Path) -> None:
    command = _job("one", ("-one.mp4", "--seed", "2"), tmp_path, {}).command()
    assert command[-7:-2] == ["run", "./-one.mp4", "--seed", "2", "--output"]
    assert arguments_of(RunOptions(Path("-one.mp4")))[0] == "./-one.mp4"


@pytest.mark.usefixtures("pretend")
def test_names_stay_with_their_recordings(tmp_path: Path) -> None:
    first = run_batch(recordings("a/walk.mp4", "b/walk.mp4"), tmp_path / "b")
    assert [run["name"] for run in first["runs"]] == ["walk", "walk-2"]
    second = run_batch(recordings("c/walk.mp4", "b/walk.mp4", "a/walk.mp4"), tmp_path / "b")
    assert [run["name"] for run in second["runs"]] == ["walk-3", "walk-2", "walk"]
    assert second["not_repeated"] == ["walk-2", "walk"]


@pytest.mark.usefixtures("pretend")
def test_a_recording_never_takes_the_folder_of_another(tmp_path: Path) -> None:
    run_batch(recordings("a/walk.mp4"), tmp_path / "b")
    other = run_batch(recordings("b/walk.mp4"), tmp_path / "b")
    third = run_batch(recordings("c/walk.mp4"), tmp_path / "b")
    assert [run["runs"][0]["name"] for run in (other, third)] == ["walk-2", "walk-3"]
    assert (tmp_path / "b" / "walk" / "starts").read_text().count("\n") == 1


@pytest.mark.usefixtures("pretend")
def test_one_recording_may_be_run_with_several_options(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("walk --seed 1\nwalk --seed 2\nwalk --seed 1\n")
    found = find_recordings([str(tmp_path / "list.txt")])
    assert [one.options for one in found] == [("--seed", "1"), ("--seed", "2")]
    first = run_batch(found, tmp_path / "b")
    again = run_batch(found[::-1], tmp_path / "b")
    assert [run["name"] for run in first["runs"]] == ["walk", "walk-2"]
    assert [run["name"] for run in again["runs"]] == ["walk-2", "walk"]
    assert again["not_repeated"] == ["walk-2", "walk"]


@pytest.mark.usefixtures("pretend")
def test_secrets_of_an_address_are_not_written_down(tmp_path: Path) -> None:
    found = recordings("rtsp://me:secret@cam.lan?key=secret")
    run_batch(found, tmp_path / "b")
    again = run_batch(found, tmp_path / "b")
    assert again["not_repeated"] == ["cam"]
    assert "secret" not in (tmp_path / "b" / "batch.json").read_text()
    assert "secret" not in (tmp_path / "b" / "batch.html").read_text()


@pytest.mark.usefixtures("pretend")
def test_stopping_ends_what_runs_and_starts_no_more(tmp_path: Path) -> None:
    stop = threading.Event()

    def progress(state: BatchProgress) -> None:
        if state.outcome.state is State.RUNNING:
            threading.Timer(0.5, stop.set).start()

    started = time.monotonic()
    content = run_batch(recordings("slow", "later"), tmp_path / "b", progress=progress, stop=stop)
    assert time.monotonic() - started < 50
    assert [run["state"] for run in content["runs"]] == ["stopped", "waiting"]


@pytest.mark.usefixtures("pretend")
def test_threads_are_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    run_batch(recordings("one"), tmp_path / "b", jobs=64)
    assert (tmp_path / "b" / "one" / "starts").read_text() == "1\n"


def test_every_job_has_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1, 2, 3}, raising=False)
    assert share_cores(1) == [[]]
    assert share_cores(2) == [[0, 1], [2, 3]]
    assert share_cores(5) == [[0], [1], [2], [3], [0]]


def test_the_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(OutputError, match="holds no earlier batch"):
        run_batch(recordings("one"), tmp_path)
    (tmp_path / "batch.json").write_text("{")
    with pytest.raises(OutputError, match="is damaged"):
        run_batch(recordings("one"), tmp_path)


def test_recordings_are_found(tmp_path: Path) -> None:
    for name in ("b.mp4", "a.mp4", "c.mov"):
        (tmp_path / name).write_text("")
    (tmp_path / "list.txt").write_text("# mine\nc.mov --camera 'my phone.yaml'\n\nrtsp://cam/1\ncamera:0\n")
    found = find_recordings([str(tmp_path / "*.mp4"), str(tmp_path / "list.txt"), str(tmp_path / "a.mp4")])
    assert [Path(one.path).name for one in found] == ["a.mp4", "b.mp4", "c.mov", "1", "camera:0"]
    assert found[2] == Recording(str(tmp_path / "c.mov"), ("--camera", "my phone.yaml"))
    assert [one.path for one in found[3:]] == ["rtsp://cam/1", "camera:0"]


def test_a_question_mark_in_an_address_is_no_pattern() -> None:
    address = "http://me:secret@cam.lan/video.txt?key=secret"
    assert find_recordings([address]) == (Recording(address),)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("none.txt", None, "no such list"),
        ("empty.txt", "# nothing\n", "lists no recordings"),
        ("open.txt", "a 'b\n", "open.txt:1: No closing quotation"),
        ("*.nothing", None, "matches no file"),
    ],
)
def test_bad_lists_are_one_line(tmp_path: Path, name: str, text: str | None, says: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=says):
        find_recordings([str(tmp_path / name)])


def test_what_a_run_said_last_is_its_error(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("tracking 3/9\nerror: rgb.txt: missing\n")
    assert failure(tmp_path / "log", 2) == "rgb.txt: missing"
    (tmp_path / "log").write_text("Traceback\n  ...\nValueError: oops\n")
    assert failure(tmp_path / "log", 1) == "ValueError: oops"
    assert failure(tmp_path / "nowhere", 3) == "ended with exit code 3"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--no-such-thing", "No such option"),
        ("--output x", "given by the batch itself"),
        ("'", "No closing quotation"),
        ("--help", "must not ask for help"),
        ("--max-frames many", "Invalid value for '--max-frames'"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(tmp_path: Path, options: str, says: str) -> None:
    done = call("batch", "one", "--output", tmp_path / "b", "--options", options)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "b").exists()


def test_the_command_runs_recordings_and_names_the_bad_one(tiny_room: Path, tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(f"{tiny_room}\nnowhere.mp4\n")
    arguments = ("batch", tmp_path / "list.txt", "--output", tmp_path / "b", "--options", QUICK, "--jobs", 2)
    done = slamdepth(*arguments)
    assert done.returncode == 1, done.stderr
    assert "no such video file" in done.stderr
    content = json.loads((tmp_path / "b" / "batch.json").read_text())
    room, missing = content["runs"]
    assert (room["state"], room["frames"], room["tracked_fraction"]) == ("done", 4, 1.0)
    assert room["verdict"] is not None
    assert missing["state"] == "failed"
    assert (tmp_path / "b" / room["name"] / "report.html").is_file()
    again = slamdepth(*arguments)
    assert json.loads((tmp_path / "b" / "batch.json").read_text())["not_repeated"] == [room["name"]]
    assert again.returncode == 1


def wait_until(what: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        if process.poll() is not None or time.monotonic() > deadline_s:
            process.kill()
            pytest.fail(f"the batch did not get there: {process.communicate()[1]}")
        time.sleep(0.05)


def start_batch(room: Path, folder: Path) -> subprocess.Popen[str]:
    """Start a batch and wait until its run is tracking."""
    process = subprocess.Popen(
        command("batch", room, "--output", folder, "--options", "--depth sensor --no-mesh"),
        env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    online = folder / "room" / "trajectory_online.txt"
    wait_until(lambda: online.exists() and online.read_text().count("\n") > 4, process)
    return process


def ends(online: Path) -> bool:
    """Whether no process writes the file any more."""
    for _ in range(100):
        before = online.stat().st_size
        time.sleep(1.0)
        if online.stat().st_size == before:
            return True
    return False


def test_ctrl_c_ends_the_runs_and_the_batch(tiny_room: Path, tmp_path: Path) -> None:
    room = make_long(tiny_room, tmp_path / "long" / "room", repeats=40)
    process = start_batch(room, tmp_path / "b")
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert stderr.splitlines()[-1].startswith("error: interrupted: finished runs are kept")
    assert json.loads((tmp_path / "b" / "batch.json").read_text())["runs"][0]["state"] == "stopped"
    assert ends(tmp_path / "b" / "room" / "trajectory_online.txt")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
def test_a_killed_batch_leaves_no_run_behind(tiny_room: Path, tmp_path: Path) -> None:
    room = make_long(tiny_room, tmp_path / "long" / "room", repeats=40)
    process = start_batch(room, tmp_path / "b")
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    assert json.loads((tmp_path / "b" / "batch.json").read_text())["runs"][0]["state"] == "waiting"
    assert ends(tmp_path / "b" / "room" / "trajectory_online.txt")


# -- Ray


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'slamdepth\[ray\]'"):
        run_batch(recordings("one"), tmp_path / "b", ray="local")
    assert not (tmp_path / "b").exists()


def test_a_local_cluster_survives_the_loss_of_a_worker(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray", reason="ray is not installed: 240 MB")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        _lose_a_worker(tmp_path)
    finally:
        ray.shutdown()


def _lose_a_worker(tmp_path: Path) -> None:
    """Two runs on two workers; the process of one worker is killed, and its run is done again."""
    from slamdepth.pipeline.batch import cluster

    marks = tmp_path / "marks"
    marks.mkdir()

    def work(job: Job, cores: int) -> object:
        from slamdepth.pipeline.batch.job import Outcome, State

        with (marks / job.name).open("a") as file:
            file.write(f"{os.getpid()}\n")
        time.sleep(3.0 if job.name == "one" and (marks / job.name).read_text().count("\n") == 1 else 0.1)
        job.folder.mkdir(exist_ok=True)
        (job.folder / "report.json").write_text("{}")
        return Outcome(State.DONE, wall_s=0.1)

    def kill_first(state: BatchProgress) -> None:
        if state.name == "one" and state.outcome.state is State.RUNNING:
            threading.Thread(target=_kill_when_named, args=(marks / "one",)).start()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "_work", work)
        content = run_batch(recordings("one", "two"), tmp_path / "b", ray="auto", jobs=2, progress=kill_first)
    assert content["counts"]["done"] == 2
    assert (marks / "one").read_text().count("\n") == 2


def _kill_when_named(mark: Path) -> None:
    deadline_s = time.monotonic() + 60
    while not mark.exists() or not mark.read_text().endswith("\n"):
        if time.monotonic() > deadline_s:
            return
        time.sleep(0.05)
    os.kill(int(mark.read_text().split()[0]), signal.SIGKILL)


def test_ray_runs_the_real_command(tiny_room: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed: 240 MB")
    content = run_batch(
        [Recording(str(tiny_room)), Recording("nowhere.mp4")],
        tmp_path / "b", ray="local", jobs=2, options=QUICK.split(),
    )  # fmt: skip
    assert [run["state"] for run in content["runs"]] == ["done", "failed"]
    assert "no such video file" in content["runs"][1]["error"]
