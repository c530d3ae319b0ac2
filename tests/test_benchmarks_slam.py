# SPDX-License-Identifier: Apache-2.0
"""The SLAM benchmark from the command line, on a rendered room; the harness, not the speed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


def slam(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.slam", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def output(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of what needs neither weights nor extras, two runs each."""
    folder = tmp_path_factory.mktemp("benchmark")
    done = slam(
        "--data", tiny_room.parent, "--sequences", tiny_room.name, "--depth", "sensor", "--pace", "fast",
        "--systems", "slamdepth,slamdepth-icp,open3d,kiss-icp", "--features", "orb,sift",
        "--max-frames", 12, "--runs", 2,
        "--cache", folder / "cache", "--output", folder / "slam.json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Open3D RGB-D odometry" in done.stdout
    return folder / "slam.json"


@pytest.fixture(scope="module")
def benchmark(output: Path) -> dict[str, Any]:
    loaded = json.loads(output.read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


def test_every_system_is_measured_in_its_own_process(benchmark: dict[str, Any]) -> None:
    rows = {row["label"]: row for row in benchmark["rows"]}
    ours = ["slamdepth", "slamdepth, sift", "slamdepth, KISS-ICP"]
    assert list(rows) == [*ours, "Open3D RGB-D odometry", "KISS-ICP"]
    for row in rows.values():
        assert row["status"] == "ok", row["message"]
        assert [run["frames"] for run in row["runs"]] == [12, 12]
        figures = row["figures"]
        assert figures["tracked"]["median"] == 1.0
        for key in ("fps", "step_ms", "cpu_ms_per_frame", "peak_memory_mib"):
            assert 0 < figures[key]["min"] <= figures[key]["median"] <= figures[key]["max"]
        assert figures["ate_sim3_m"]["median"] <= figures["ate_se3_m"]["median"] + 1e-9
    memory = [row["figures"]["peak_memory_mib"]["median"] for row in rows.values()]
    assert len(set(memory)) == len(memory)


def test_exact_depth_of_a_room_gives_good_trajectories(benchmark: dict[str, Any]) -> None:
    ate = {row["label"]: row["figures"]["ate_se3_m"]["median"] for row in benchmark["rows"]}
    assert ate["slamdepth"] < 0.02
    assert ate["slamdepth, sift"] < 0.02
    assert all(value < 0.15 for value in ate.values()), ate


def test_a_repeated_run_has_the_same_errors(benchmark: dict[str, Any]) -> None:
    ours = benchmark["rows"][0]["figures"]
    for key in ("ate_se3_m", "ate_sim3_m", "scale"):
        assert ours[key]["min"] == ours[key]["max"]


def test_the_file_says_what_was_run_on_what(benchmark: dict[str, Any]) -> None:
    assert benchmark["settings"]["runs"] == 2
    assert benchmark["settings"]["pace"] == "fast"
    environment = benchmark["environment"]
    assert {"cpu", "cores"} <= environment["hardware"].keys()
    assert {"slamdepth", "commit", "open3d-cpu", "kiss-icp", "pyorbslam3"} <= environment["versions"].keys()


def test_no_path_of_the_machine_is_published(output: Path, tiny_room: Path) -> None:
    assert str(tiny_room.parent) not in output.read_text(encoding="utf-8")


def test_tables_and_plot_lie_beside_the_file(output: Path) -> None:
    table = output.with_suffix(".md").read_text(encoding="utf-8")
    assert "| slamdepth | sensor | 100.0 |" in table
    assert output.with_suffix(".svg").read_text(encoding="utf-8").lstrip().startswith("<?xml")


def test_comparison_with_an_earlier_file(output: Path, tiny_room: Path) -> None:
    done = slam(
        "--data", tiny_room.parent, "--sequences", tiny_room.name, "--depth", "sensor", "--pace", "fast",
        "--systems", "open3d", "--max-frames", 8, "--compare", output,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "change against" in done.stdout
    assert "not the same settings as then" in done.stdout


def test_a_missing_peer_is_a_row_not_a_crash(
    tiny_room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setitem(sys.modules, "pyorbslam3", None)
    from benchmarks.slam import main

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
        (("--runs", 0), "--runs: at least 1"),
        (("--max-frames", 0), "must be 1 or more"),
        (("--sequences", "nowhere"), "nowhere"),
        (("--compare", "no.json"), "no.json: cannot be read"),
        (("--vocabulary", "no.txt"), "no.txt: no such vocabulary file"),
    ],
)
def test_bad_input_is_one_line(tiny_room: Path, arguments: tuple[object, ...], message: str) -> None:
    done = slam("--data", tiny_room.parent, "--sequences", tiny_room.name, *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
