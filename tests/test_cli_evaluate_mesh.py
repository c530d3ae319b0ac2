# SPDX-License-Identifier: Apache-2.0
"""``slamdepth evaluate-mesh`` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call, slamdepth
from surfaces import wall
from test_evaluation_surface import write_mesh

from slamdepth.evaluation.surface_file import read_surface
from slamdepth.io import read_image_rgb


@pytest.fixture(scope="module")
def sensor_run(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the rendered room with its exact depth."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    ended = call("run", tiny_room, "--depth", "sensor", "--output", folder, "--quiet")
    assert ended.returncode == 0, ended.stderr
    assert "mesh, Sim(3)" in ended.stdout
    return folder


def test_a_run_is_scored_against_its_sequence(sensor_run: Path, tiny_room: Path, tmp_path: Path) -> None:
    output = tmp_path / "score.json"
    ended = slamdepth("evaluate-mesh", sensor_run, tiny_room, "--align", "se3", "--output", output)
    assert ended.returncode == 0, ended.stderr
    assert "within 5 cm" in ended.stdout
    assert "alignment: se3" in ended.stdout
    figures = json.loads(output.read_text())
    assert figures["align"] == "se3"
    assert figures["within"]["5cm"]["f_score"] > 0.9
    report = json.loads((sensor_run / "report.json").read_text())["surface"]
    assert figures["accuracy"]["median_m"] == pytest.approx(report["se3"]["accuracy"]["median_m"], abs=1e-4)
    for kind in ("accuracy", "completion"):
        assert len(read_surface(tmp_path / f"score_{kind}.ply").triangles) > 100
    image = read_image_rgb(tmp_path / "score.png")
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100


def test_the_trajectory_next_to_a_mesh_is_taken_with_a_note(sensor_run: Path, tiny_room: Path) -> None:
    ended = call("evaluate-mesh", sensor_run / "mesh.ply", tiny_room, "--max-frames", "20")
    assert ended.returncode == 0, ended.stderr
    assert "alignment: sim3" in ended.stdout
    assert "aligned by the trajectory.txt next to the mesh" in ended.stdout


def test_two_files_are_compared_as_they_are(tmp_path: Path) -> None:
    near, far = (write_mesh(tmp_path / f"{z}.ply", wall(z)) for z in (2.0, 2.03))
    ended = call("evaluate-mesh", near, far, "--quiet")
    assert ended.returncode == 0, ended.stderr
    assert "median 3.00 cm" in ended.stdout
    assert "alignment: none" in ended.stdout
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["2.0.ply", "2.03.ply"]


def test_bad_input_is_one_line(tiny_room: Path, tmp_path: Path) -> None:
    mesh = write_mesh(tmp_path / "mesh.ply", wall(2.0))
    (tmp_path / "folder").mkdir()
    for arguments, message in (
        ((tmp_path / "absent.ply", mesh), "absent.ply: no such file"),
        ((mesh, tmp_path / "absent.ply"), "absent.ply: no such file"),
        ((mesh, tiny_room / "rgb.txt"), "must end in one of"),
        ((tmp_path / "folder", mesh), "without mesh.ply"),
        ((mesh, mesh, "--align", "sim3"), "no ground truth to align trajectories by"),
        ((mesh, tiny_room, "--align", "sim3"), "needs the trajectory of the mesh"),
        ((mesh, tiny_room, "--align", "icp"), "none, se3, sim3, got 'icp'"),
        ((mesh, tiny_room, "--max-depth", "0"), "--max-depth must be positive"),
        ((mesh, tmp_path / "folder"), "folder"),
        ((mesh, mesh, "--output", tmp_path / "absent" / "score.json"), "no such folder"),
    ):
        ended = call("evaluate-mesh", *arguments)
        assert ended.returncode == 2, arguments
        assert message in ended.stderr
        last = ended.stderr.strip().splitlines()
        assert last[-1].startswith("error: ")
        assert "Traceback" not in ended.stderr


def test_bad_input_is_one_line_of_the_process_too(tmp_path: Path) -> None:
    ended = slamdepth("evaluate-mesh", tmp_path / "absent.ply", tmp_path / "absent.ply")
    assert ended.returncode == 2
    assert ended.stderr.strip().splitlines() == [f"error: {tmp_path}/absent.ply: no such file"]
