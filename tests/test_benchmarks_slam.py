# SPDX-License-Identifier: Apache-2.0
"""The SLAM benchmark from the command line, on a rendered room; the harness, not the speed."""

from __future__ import annotations

import json
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from benchmarks.jobs import Job
from benchmarks.rows import Row, plan_rows
from benchmarks.slam import main
from benchmarks.worker import run

FRAMES = 12


@pytest.fixture(scope="module")
def output(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of two systems that need neither weights nor extras."""
    folder = tmp_path_factory.mktemp("benchmark")
    arguments = ["--data", str(tiny_room.parent), "--sequences", tiny_room.name, "--depth", "sensor"]
    arguments += ["--systems", "slamdepth,open3d", "--pace", "fast", "--max-frames", str(FRAMES)]
    printed = StringIO()
    with redirect_stdout(printed):
        assert main([*arguments, "--output", str(folder / "slam.json")]) == 0
    assert "Open3D RGB-D odometry" in printed.getvalue()
    return folder / "slam.json"


@pytest.fixture(scope="module")
def benchmark(output: Path) -> dict[str, Any]:
    loaded = json.loads(output.read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


def test_every_system_is_measured_in_its_own_process(benchmark: dict[str, Any]) -> None:
    rows = {row["label"]: row for row in benchmark["rows"]}
    assert list(rows) == ["slamdepth", "Open3D RGB-D odometry"]
    for row in rows.values():
        assert row["status"] == "ok", row["message"]
        assert (row["runs"], row["frames"]) == (1, FRAMES)
        for key in ("fps", "step_ms", "cpu_ms_per_frame", "peak_memory_mib"):
            assert row["figures"][key] > 0
    first, second = (row["figures"]["peak_memory_mib"] for row in rows.values())
    assert first != second


_SYSTEMS = ["slamdepth", "slamdepth-icp", "open3d", "kiss-icp"]
_ROWS = plan_rows(_SYSTEMS, ["sensor"], [{"name": "orb"}, {"name": "sift"}])


@pytest.mark.parametrize("row", _ROWS, ids=lambda row: row.label)
def test_exact_depth_of_a_room_gives_a_good_trajectory(tiny_room: Path, row: Row) -> None:
    result = run(Job(str(tiny_room), row, pace="fast", max_frames=FRAMES))
    assert (result["status"], result["frames"], result["notes"]) == ("ok", FRAMES, [])
    figures = result["figures"]
    assert figures["tracked"] == 1.0
    assert figures["ate_sim3_m"] <= figures["ate_se3_m"] + 1e-9
    assert figures["ate_se3_m"] < (0.02 if row.label in {"slamdepth", "slamdepth, sift"} else 0.15)


def test_the_file_says_what_was_run_on_what(benchmark: dict[str, Any]) -> None:
    assert benchmark["settings"]["runs"] == 1
    assert benchmark["settings"]["pace"] == "fast"
    environment = benchmark["environment"]
    assert {"cpu", "cores", "instructions"} <= environment["hardware"].keys()
    assert {"slamdepth", "commit", "open3d-cpu", "kiss-icp", "pyorbslam3"} <= environment["versions"].keys()


def test_no_path_of_the_machine_is_published(output: Path, tiny_room: Path) -> None:
    assert str(tiny_room.parent) not in output.read_text(encoding="utf-8")


def test_tables_and_plot_have_the_name_of_the_file(output: Path) -> None:
    table = output.with_suffix(".md").read_text(encoding="utf-8")
    assert "| slamdepth | sensor | 100.0 |" in table
    assert output.with_suffix(".svg").read_text(encoding="utf-8").lstrip().startswith("<?xml")


def test_a_repeated_run_has_the_same_errors_and_is_compared_with_an_earlier_file(
    output: Path, tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--data", str(tiny_room.parent), "--sequences", tiny_room.name, "--depth", "sensor"]
    arguments += ["--systems", "slamdepth", "--pace", "fast", "--max-frames", "12", "--runs", "2"]
    repeated = tmp_path / "repeated.json"
    assert main([*arguments, "--compare", str(output), "--output", str(repeated)]) == 0
    (row,) = json.loads(repeated.read_text(encoding="utf-8"))["rows"]
    assert row["runs"] == 2
    assert row["spread"]  # of times
    assert not {"ate_se3_m", "ate_sim3_m", "scale"} & row["spread"].keys()
    printed = capsys.readouterr().out
    assert "change against" in printed
    assert "not the same settings as then" in printed
    assert "not the same hardware" not in printed


def test_a_missing_peer_is_a_row_not_a_crash(
    tiny_room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyorbslam3", None)
    arguments = ["--data", str(tiny_room.parent), "--sequences", tiny_room.name]
    assert main([*arguments, "--systems", "orbslam3", "--depth", "sensor"]) == 0
    assert capsys.readouterr().out.count("not installed: pip install '.[bench]'") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--systems", "slamdepth,vins"), "no system is called 'vins'; known: slamdepth, slamdepth-icp"),
        (("--depth", "lidar"), "no depth is called 'lidar'; known: "),
        (("--depth", "mirrored:lidar"), "no depth is called 'mirrored:lidar'; known: "),
        (("--features", "orb,surf"), "no feature is called 'surf'; known: "),
        (("--features", "sift", "--ablation"), "--features: not together with --ablation"),
        (("--runs", "0"), "--runs: at least 1"),
        (("--max-frames", "0"), "must be 1 or more"),
        (("--sequences", "nowhere"), "nowhere"),
        (("--compare", "no.json"), "no.json: cannot be read"),
        (("--vocabulary", "no.txt"), "no.txt: no such vocabulary file"),
    ],
)
def test_bad_input_is_one_line(
    tiny_room: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(tiny_room.parent), "--sequences", tiny_room.name, *arguments]) == 2
    assert message in capsys.readouterr().err
