# SPDX-License-Identifier: Apache-2.0
"""Run folders read back, compared and rendered, in Python and by the command line."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from command_line import call, slamdepth
from scene_data import RED, data_with_scene, room_mesh, write_run

from slamdepth.errors import ConfigError, DatasetError
from slamdepth.geometry import invert
from slamdepth.io import write_tum_trajectory
from slamdepth.pipeline.flight import FlightQuestion, render_flight
from slamdepth.report.compare import build_compare_html, compare_runs
from slamdepth.report.flight import draw_flight, plan_flight
from slamdepth.report.saved_run import read_run
from slamdepth.report.scene import SCENE_FILE
from slamdepth.report.viewpoints import ideal_camera
from slamdepth.tracking.finish import _loops
from slamdepth.types import Trajectory


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "first")


@pytest.fixture
def another(run_folder: Path, tmp_path: Path) -> Path:
    """The same run with another setting, half the speed, and a path of twice the size."""
    folder = tmp_path / "second"
    shutil.copytree(run_folder, folder)
    summary = json.loads((folder / "report.json").read_text())
    summary["fps"] /= 2
    summary["settings"]["map"]["voxel_size_m"] = 0.05
    (folder / "report.json").write_text(json.dumps(summary))
    path = read_run(run_folder).scene.maps[0].path
    poses = path.T_world_camera.copy()
    poses[:, :3, 3] *= 2.0
    write_tum_trajectory(folder / "trajectory.txt", Trajectory(path.timestamps_s, poses))
    return folder


def test_a_run_folder_is_read_back(run_folder: Path) -> None:
    run = read_run(run_folder).with_meshes()
    one, expected = run.scene.maps[0], data_with_scene().scene
    assert expected is not None
    np.testing.assert_allclose(one.path.T_world_camera, expected.maps[0].path.T_world_camera, atol=1e-5)
    assert len(one.thumbnails) == 6
    assert one.mesh is not None
    np.testing.assert_allclose(one.mesh.colors, room_mesh().colors, atol=0.003)
    assert run.notes == ()


def test_a_run_of_an_older_version_has_path_and_keyframes_but_no_images(
    run_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(run_folder, tmp_path / "old")
    (tmp_path / "old" / SCENE_FILE).unlink()
    run = read_run(tmp_path / "old")
    assert (len(run.scene.maps[0].path), len(run.scene.maps[0].keyframes)) == (70, 6)
    assert run.scene.maps[0].thumbnails == ()
    assert "made by an older slamdepth" in run.notes[0]


def test_a_run_that_placed_no_frame_is_read_compared_and_has_no_video(
    run_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(run_folder, tmp_path / "lost")
    write_tum_trajectory(tmp_path / "lost" / "trajectory.txt", Trajectory.empty())
    lost = read_run(tmp_path / "lost")
    assert len(lost.scene.maps[0].path) == 0
    found = compare_runs([read_run(run_folder), lost])
    assert found.to_first == (None, None)
    assert "too little in common" in found.notes[0]
    assert build_compare_html(found).count("<svg") == 3
    with pytest.raises(DatasetError, match="no such mesh"):
        render_flight(FlightQuestion(tmp_path / "lost", tmp_path / "x.mp4"), lambda done, total: None)


def test_what_is_no_finished_run_is_refused_in_one_line(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such run folder"):
        read_run(tmp_path / "absent")
    with pytest.raises(DatasetError, match="no folder of 'slamdepth run'"):
        read_run(tmp_path)
    (tmp_path / "trajectory_online.txt").write_text("")
    with pytest.raises(DatasetError, match="has not finished"):
        read_run(tmp_path)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(DatasetError, match="is no report of a run"):
        read_run(tmp_path)
    (tmp_path / "report.json").write_text("{")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_run(tmp_path)


def test_runs_are_compared_by_figures_settings_and_paths(run_folder: Path, another: Path) -> None:
    found = compare_runs([read_run(run_folder), read_run(another)])
    assert found.names == ("first", "second")
    figures = {row.name: row for row in found.figures}
    assert figures["frames per second"].shown == ("12.5", "6.2")
    assert figures["frames per second"].best == (0,)
    assert figures["ATE SE(3), RMSE (m)"].best == ()  # equal
    assert [row.name for row in found.differences] == ["map.voxel_size_m"]
    score = found.to_first[1]
    assert score is not None
    assert score.sim3.scale == pytest.approx(0.5, abs=1e-3)
    assert score.sim3.rmse_m < 1e-4
    assert json.loads(json.dumps(found.to_dict()))["distance_to_first"][0] is None
    page = build_compare_html(found)
    assert page.count("<svg") == 3
    assert "<script" not in page


def test_runs_of_other_sequences_and_of_equal_names_are_told_apart(run_folder: Path, another: Path) -> None:
    same_name = another.parent / "elsewhere" / "first"
    shutil.copytree(another, same_name)
    summary = json.loads((same_name / "report.json").read_text())
    (same_name / "report.json").write_text(json.dumps({**summary, "sequence": "hall"}))
    path = read_run(another).scene.maps[0].path
    write_tum_trajectory(same_name / "trajectory.txt", replace(path, timestamps_s=path.timestamps_s + 1000))
    found = compare_runs([read_run(run_folder), read_run(same_name)])
    assert found.names[1] == "elsewhere/first"
    assert found.to_first == (None, None)
    assert all(row.best == () for row in found.figures)
    assert len(found.notes) == 2
    with pytest.raises(ConfigError, match="two or more"):
        compare_runs([read_run(run_folder)])


def test_the_compare_command_prints_a_table_and_writes_page_and_figures(
    run_folder: Path, another: Path, tmp_path: Path
) -> None:
    done = slamdepth("compare", run_folder, another, "--output", tmp_path / "both.html")
    assert done.returncode == 0, done.stderr
    assert re.search(r"frames per second\s+12\.5\s+6\.2", done.stdout)
    assert re.search(r"map\.voxel_size_m\s+0\.02\s+0\.05", done.stdout)
    assert (tmp_path / "both.html").read_text().startswith("<!doctype html>")
    assert json.loads((tmp_path / "both.json").read_text())["runs"] == ["first", "second"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["compare", "{run}", "-o", "{new}/x.html"], "two or more"),
        (["compare", "{run}", "{new}", "-o", "{new}/x.html"], "no folder of 'slamdepth run'"),
        (["compare", "{run}", "{run}", "-o", "{new}/x.txt"], "must end in .html"),
        (["compare", "{run}", "{run}", "-o", "{new}/absent/x.html"], "no such folder"),
        (["render", "{new}"], "no folder of 'slamdepth run'"),
        (["render", "{run}", "--size", "big"], "WIDTHxHEIGHT"),
        (["render", "{run}", "--size", "641x360"], "even numbers"),
        (["render", "{run}", "--seconds", "0"], "length must be"),
        (["render", "{run}", "--fps", "0.1"], "frame rate"),
        (["render", "{run}", "--map", "2"], "has no map 2"),
        (["render", "{run}", "-o", "{new}/x.avi"], "must end in .mp4"),
        (["view", "{new}"], "no folder of 'slamdepth run'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    run_folder: Path, tmp_path: Path, arguments: list[str], says: str
) -> None:
    done = call(*(one.format(run=run_folder, new=tmp_path) for one in arguments))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_a_mesh_has_no_video(run_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(run_folder, tmp_path / "bare")
    (tmp_path / "bare" / "mesh.ply").unlink()
    with pytest.raises(DatasetError, match="run again without --no-mesh"):
        render_flight(FlightQuestion(tmp_path / "bare", tmp_path / "x.mp4"), lambda done, total: None)
    assert not (tmp_path / "x.mp4").exists()


def test_a_flight_starts_and_ends_above_and_is_behind_the_camera_between(run_folder: Path) -> None:
    one = read_run(run_folder).with_meshes().scene.maps[0]
    flight = plan_flight(one, 50)
    places = one.path.T_world_camera[flight.at, :3, 3]
    heights = flight.T_world_camera[:, 1, 3] - places[:, 1]  # y is down
    assert heights[0] < -1.0
    assert heights[-1] < -1.0
    seen = np.stack(
        [invert(T)[:3, :3] @ p + invert(T)[:3, 3] for T, p in zip(flight.T_world_camera, places, strict=True)]
    )
    assert (seen[:, 2] > 0).all()
    middle = slice(15, 40)
    distance = np.linalg.norm(seen[middle], axis=1)
    assert distance.max() < 0.4 * flight.size_m
    assert flight.at[0] == 0
    assert flight.at[-1] == len(one.path) - 1
    steps = np.linalg.norm(np.diff(flight.T_world_camera[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.35 * flight.size_m


def test_images_of_a_flight_show_mesh_path_and_keyframe(run_folder: Path) -> None:
    run = read_run(run_folder).with_meshes()
    one = run.scene.maps[0]
    flight = plan_flight(one, 20)
    image = draw_flight(one, flight, 19, ideal_camera(320, 180, 60.0), run.scene.aspect)
    assert image.shape == (180, 320, 3)
    red = np.abs(image / np.maximum(image.max(axis=2, keepdims=True), 1) - np.array(RED) / max(RED)).max(
        axis=2
    )
    assert np.mean(red < 0.1) > 0.02
    assert np.mean(np.abs(image.astype(int) - (74, 158, 255)).max(axis=2) < 60) > 0.0005
    assert np.mean(np.abs(image.astype(int) - (247, 158, 40)).max(axis=2) < 30) > 0.002


def test_the_render_command_writes_a_video_of_that_size_and_length(run_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "room.mp4"
    done = slamdepth("render", run_folder, "-o", out, "--seconds", 1, "--fps", 8, "--size", "160x96")
    assert done.returncode == 0, done.stderr
    assert "rendering" in done.stderr
    video = cv2.VideoCapture(str(out))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (160, 96)
    frames = []
    while True:
        ok, frame = video.read()
        if not ok:
            break
        frames.append(frame)
    assert len(frames) == 8
    assert np.abs(frames[0].astype(int) - frames[4]).mean() > 5


def test_loops_of_a_result_are_named_by_the_numbers_that_its_keyframes_have() -> None:
    """Keyframes are numbered anew by time, and those without a pose are left out."""
    in_time = [SimpleNamespace(id=number) for number in (3, 0, 1, 2)]
    kept = [SimpleNamespace(id=number) for number in (0, 1, 2)]
    integration = SimpleNamespace(loops=SimpleNamespace(pairs=((0, 3), (1, 0), (2, 0))))
    assert _loops(integration, in_time, kept) == ((0, 1), (1, 2))  # type: ignore[arg-type]
