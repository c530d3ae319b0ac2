# SPDX-License-Identifier: Apache-2.0
"""The command line on a small rendered room: what it prints, writes and returns."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from command_line import call, copy_of, images, leave_out_plots, replace_image, slamdepth

from slamdepth.cli.console import console, print_places
from slamdepth.io import read_tum_trajectory

COMMANDS = (
    "run", "view", "compare", "render", "scale", "synth", "evaluate", "evaluate-mesh", "depth", "data-stats",
    "train-depth", "eval-depth", "weights list", "weights pull",
)  # fmt: skip


FRAMES = 24
RUN = ("run", "--depth", "sensor", "--max-frames", FRAMES)


@pytest.fixture(autouse=True)
def wide_terminal_and_no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("NO_COLOR", "1")


@pytest.fixture(scope="module")
def run_folder(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run in a process of its own, with its output in ``stdout.txt``."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    done = slamdepth(*RUN, tiny_room, "--output", folder, "--voxel-size", 0.04)
    assert done.returncode == 0, done.stderr
    (folder / "stdout.txt").write_text(done.stdout)
    return folder


@pytest.fixture(scope="module")
def report(run_folder: Path) -> dict[str, Any]:
    return dict(json.loads((run_folder / "report.json").read_text()))


@pytest.mark.parametrize("command", ["", "weights", *COMMANDS])
def test_every_command_explains_itself_with_an_example(command: str) -> None:
    done = call(*command.split(), "--help")
    assert done.returncode == 0
    assert f"Example: slamdepth {command}" in done.stdout


def test_the_version() -> None:
    import slamdepth as package

    assert slamdepth("--version").stdout == f"slamdepth {package.__version__}\n"


def test_a_run_says_first_whether_it_can_be_trusted(run_folder: Path, report: dict[str, Any]) -> None:
    lines = [line for line in (run_folder / "stdout.txt").read_text().splitlines() if line.strip()]
    assert lines[1].split()[:2] == ["verdict", "Reliable:"]
    assert report["health"]["verdict"] == "good"
    assert report["health"]["headline"] in (run_folder / "report.html").read_text(encoding="utf-8")


def test_a_run_writes_everything_it_promises(run_folder: Path) -> None:
    promised = (
        "trajectory_online.txt trajectory.txt keyframes.txt mesh.ply cloud.ply mesh.png report.json "
        "report.html scene.safetensors config.yaml log.txt README.txt map"
    )
    assert {path.name for path in run_folder.iterdir()} == {*promised.split(), "stdout.txt"}
    online, _ = read_tum_trajectory(run_folder / "trajectory_online.txt")
    final, _ = read_tum_trajectory(run_folder / "trajectory.txt")
    keyframes, _ = read_tum_trajectory(run_folder / "keyframes.txt")
    assert online.timestamps_s.tolist() == final.timestamps_s.tolist()
    assert set(keyframes.timestamps_s) <= set(final.timestamps_s)
    assert (run_folder / "mesh.ply").read_bytes().startswith(b"ply\n")
    assert (run_folder / "mesh.png").read_bytes().startswith(b"\x89PNG")


def test_the_room_is_tracked(report: dict[str, Any]) -> None:
    assert report["tracked"] == report["frames"] == FRAMES
    assert report["ate"]["se3"]["rmse_m"] < 0.02


def test_the_report_has_the_promised_keys(report: dict[str, Any]) -> None:
    promised = (
        "frames tracked tracked_fraction keyframes loop_closures relocalisations fps timings_ms "
        "ate.se3.rmse_m ate.sim3.rmse_m ate.sim3.scale rpe.per_frame.trans_rmse_m rpe.per_frame.rot_rmse_deg "
        "rpe.per_second.trans_rmse_m rpe.per_second.rot_rmse_deg depth.metric.abs_rel depth.metric.rmse_m "
        "depth.metric.delta1 depth.sequence_median.abs_rel depth.frame_median.delta1 mesh.vertices "
        "mesh.triangles versions hardware settings weights"
    )
    for key in promised.split():
        value: Any = report
        for part in key.split("."):
            value = value[part]


def test_the_table_says_what_came_out_and_where(run_folder: Path, report: dict[str, Any]) -> None:
    shown = (run_folder / "stdout.txt").read_text()
    for row in (
        "frames",
        "tracked",
        "frames per second",
        "keyframes",
        "loop closures",
        "scale",
        "ATE",
        "RPE",
        "mesh",
    ):
        assert row in shown
    assert f"{report['ate']['se3']['rmse_m']:.4f} m" in shown
    for name in ("trajectory.txt", "mesh.ply", "report.html"):
        assert f"   {run_folder}/{name}\n" in shown


def test_paths_are_never_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    path = "/a folder/" + "long-" * 60 + "/[bold]report.html"
    written = io.StringIO()
    for columns in ("40", None):
        written.truncate(0)
        monkeypatch.setenv("COLUMNS", "40")
        if columns is None:
            monkeypatch.delenv("COLUMNS")
        with redirect_stdout(written):
            out = console()
            print_places(out, {"results": path, "report": path})
            out.print("word " * 60)
        assert written.getvalue().count(f"   {path}\n") == 2
        assert (written.getvalue().count("\n") == 3) is (columns is None)


def test_the_report_names_no_folder_of_this_machine(run_folder: Path) -> None:
    for name in ("report.json", "report.html", "config.yaml"):
        assert str(run_folder.parent) not in (run_folder / name).read_text()


def test_the_same_command_gives_the_same_bytes(run_folder: Path, tiny_room: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    config = run_folder / "config.yaml"
    done = slamdepth(
        "run", tiny_room, "--config", config, "--max-frames", FRAMES, "--output", again, "--quiet"
    )
    assert done.returncode == 0, done.stderr
    for name in (
        "trajectory.txt",
        "trajectory_online.txt",
        "keyframes.txt",
        "mesh.ply",
        "cloud.ply",
        "mesh.png",
    ):
        assert (again / name).read_bytes() == (run_folder / name).read_bytes(), name


def test_evaluate_gives_the_figures_of_the_report(
    run_folder: Path, report: dict[str, Any], tiny_room: Path, tmp_path: Path
) -> None:
    out = tmp_path / "score.json"
    done = call("evaluate", tiny_room / "groundtruth.txt", run_folder / "trajectory.txt", "--output", out)
    assert done.returncode == 0, done.stderr
    score = json.loads(out.read_text())
    for kind in ("se3", "sim3"):
        assert score["ate"][kind]["rmse_m"] == pytest.approx(report["ate"][kind]["rmse_m"], abs=1e-8)
        assert f"{score['ate'][kind]['rmse_m']:.6f} m" in done.stdout


def test_a_score_of_an_earlier_call_is_replaced(tiny_room: Path, tmp_path: Path) -> None:
    out = tmp_path / "score.json"
    truth = tiny_room / "groundtruth.txt"
    for fps in (10, 30):
        done = call("evaluate", truth, truth, "--fps", fps, "--output", out)
        assert done.returncode == 0, done.stderr
        assert json.loads(out.read_text())["rpe"]["per_second"]["delta_frames"] == fps


def test_stride_limit_and_no_mesh(tiny_room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done = call(
        "run",
        tiny_room,
        "--depth",
        "sensor",
        "--output",
        folder,
        "--stride",
        2,
        "--max-frames",
        6,
        "--no-mesh",
    )
    assert done.returncode == 0, done.stderr
    assert not (folder / "mesh.ply").exists()
    assert not (folder / "mesh.png").exists()
    assert "no image of one" in (folder / "report.html").read_text(encoding="utf-8")
    times = read_tum_trajectory(folder / "trajectory.txt")[0].timestamps_s
    expected = read_tum_trajectory(tiny_room / "groundtruth.txt")[0].timestamps_s[:12:2]
    assert times.tolist() == expected.tolist()


def test_command_line_over_file_over_defaults(tiny_room: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text("seed: 5\nmap: {voxel_size_m: 0.07, max_depth_m: 3.0}\n")
    done = call(
        "run", tiny_room, "--depth", "sensor", "--config", tmp_path / "settings.yaml", "--voxel-size", "0.05",
        "--output", tmp_path / "run", "--max-frames", 3, "--no-mesh",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    settings = json.loads((tmp_path / "run" / "report.json").read_text())["settings"]
    assert settings["seed"] == 5
    assert settings["map"]["voxel_size_m"] == 0.05
    assert settings["map"]["max_depth_m"] == 3.0
    assert settings["device"] == "cpu"


def test_images_that_do_not_decode_are_skipped_and_counted(tiny_room: Path, tmp_path: Path) -> None:
    sequence = copy_of(tiny_room, tmp_path / "room")
    broken = images(sequence)[5]
    replace_image(broken, broken.read_bytes()[:1000])
    replace_image(images(sequence)[6], b"")
    done = call(
        "run", sequence, "--depth", "sensor", "--output", tmp_path / "run", "--max-frames", 12, "--no-mesh"
    )
    assert done.returncode == 0, done.stderr
    assert broken.name in "".join(done.stderr.split())
    found = json.loads((tmp_path / "run" / "report.json").read_text())
    assert (found["skipped_frames"], found["frames"]) == (2, 10)


def test_bad_ground_truth_rows_are_dropped_with_a_count(tiny_room: Path, tmp_path: Path) -> None:
    sequence = copy_of(tiny_room, tmp_path / "room")
    rows = (sequence / "groundtruth.txt").read_text().splitlines()
    first = next(i for i, row in enumerate(rows) if not row.startswith("#"))
    rows[first] = rows[first].split()[0] + " nan 0 0 0 0 0 1"
    rows[first + 1] = rows[first + 1].split()[0] + " 1 0 0 0 0 0 0"
    (sequence / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    done = call(
        "run", sequence, "--depth", "sensor", "--output", tmp_path / "run", "--max-frames", 8, "--no-mesh"
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "run" / "report.json").read_text())
    assert any("2 rows" in note for note in found["notes"])
    assert found["ate"]["matched_poses"] == 6


def test_an_earlier_run_is_kept_without_overwrite(run_folder: Path, tiny_room: Path) -> None:
    before = (run_folder / "trajectory.txt").read_bytes()
    done = call("run", tiny_room, "--depth", "sensor", "--output", run_folder)
    assert done.returncode == 2
    assert "--overwrite" in done.stderr
    assert (run_folder / "trajectory.txt").read_bytes() == before


def test_synth_then_read(tmp_path: Path) -> None:
    size = ("--width", 64, "--height", 48)
    done = call("synth", tmp_path / "room", "--frames", 2, *size, "--seed", 4, "--texture", "low")
    assert done.returncode == 0, done.stderr
    assert len(images(tmp_path / "room")) == 2
    assert (tmp_path / "room" / "camera.yaml").exists()


def test_weights_are_listed_also_where_there_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    done = call("weights", "list")
    assert done.returncode == 0, done.stderr
    assert "dinov2_vits14" in done.stdout
    assert "absent" in done.stdout
    assert not (tmp_path / "cache").exists()
