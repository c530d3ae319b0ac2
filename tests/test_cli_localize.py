# SPDX-License-Identifier: Apache-2.0
"""``slamdepth localize``, ``run --map`` and the map a run leaves."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import BagWriter
from command_line import call, copy_of, images, leave_out_plots, slamdepth

from slamdepth import Map, localize, open_dataset
from slamdepth.io import read_tum_trajectory
from slamdepth.pipeline.options import RunInterrupted


@pytest.fixture(scope="module")
def run_folder(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "room"
    with pytest.MonkeyPatch.context() as patch:
        leave_out_plots(patch)
        arguments = ("--depth", "sensor", "--no-mesh", "--max-frames", 30, "--map-images")
        done = call("run", tiny_room, "--output", folder, *arguments)
    assert done.returncode == 0, done.stderr
    return folder


def digest(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def test_a_run_leaves_a_map(run_folder: Path) -> None:
    saved = Map.load(run_folder)
    assert saved.has_images
    assert saved.is_measured
    assert saved.sessions[0].frames == 30
    assert saved.scale["source"] == "sensor"
    estimate, _ = read_tum_trajectory(run_folder / "trajectory.txt")
    assert saved.trajectory().T_world_camera == pytest.approx(estimate.T_world_camera, abs=1e-6)
    assert "map/" in (run_folder / "README.txt").read_text()


def test_a_bag_is_placed_by_the_topic_that_is_asked_for(
    run_folder: Path, tiny_room: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rosbags")
    dataset = open_dataset(tiny_room)
    with BagWriter(tmp_path / "two.bag", "ros1") as bag:
        for frame in (dataset.read(index) for index in range(3)):
            time_s = frame.timestamp_s + 1.0
            for topic, image in (("/a", np.zeros_like(frame.image_rgb)), ("/room", frame.image_rgb)):
                bag.write(f"{topic}/image_raw", bag.image(time_s, topic, image, "rgb8"), time_s)
                info = bag.camera_info(time_s, topic, dataset.camera)
                bag.write(f"{topic}/camera_info", info, time_s)
    out = tmp_path / "found"
    asked = ("localize", "--map", run_folder, tmp_path / "two.bag", "--output", out)
    assert call(*asked, "--topic", "/room/image_raw").returncode == 0
    assert json.loads((out / "localized.json").read_text())["placed"] == 3


def test_a_run_does_not_replace_the_map_it_goes_on_from(run_folder: Path, tiny_room: Path) -> None:
    before = digest(run_folder / "map")
    asked = ("run", tiny_room, "--depth", "sensor", "--map", run_folder, "--output", run_folder)
    done = call(*asked, "--overwrite")
    assert done.returncode == 2
    assert "which would be removed with the run there" in done.stderr
    assert digest(run_folder / "map") == before


def test_a_live_source_is_not_placed(run_folder: Path, tmp_path: Path) -> None:
    done = call("localize", "--map", run_folder, "http://me:secret@127.0.0.1:9/video")
    assert done.returncode == 2
    assert "is a live source; only recordings are placed" in done.stderr
    assert "secret" not in done.stderr


def test_an_interrupt_before_the_first_frame_is_no_fault_of_the_images(
    run_folder: Path, tiny_room: Path
) -> None:
    with pytest.raises(RunInterrupted, match="before the first frame"):
        localize(run_folder, tiny_room, stop=lambda: True)


def test_a_sequence_is_placed_in_the_map(run_folder: Path, tiny_room: Path, tmp_path: Path) -> None:
    before = digest(run_folder / "map")
    out = tmp_path / "found"
    done = slamdepth("localize", "--map", run_folder, tiny_room, "--output", out)
    assert done.returncode == 0, done.stderr
    assert "placed" in done.stdout
    trajectory, _ = read_tum_trajectory(out / "trajectory.txt")
    with (out / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    figures = json.loads((out / "localized.json").read_text())
    assert len(rows) == figures["frames"] == 40
    assert len(trajectory) == figures["placed"] >= 30
    assert sum(row["tx"] != "" for row in rows) == len(trajectory)
    assert all(0.0 <= float(row["quality"]) <= 1.0 for row in rows)
    assert digest(run_folder / "map") == before
    again = call("localize", "--map", run_folder, tiny_room, "--output", out)
    assert (again.returncode, "add --overwrite" in again.stderr) == (2, True)


@pytest.fixture(scope="module")
def without_camera(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    sequence = copy_of(tiny_room, tmp_path_factory.mktemp("no-camera") / "walk")
    (sequence / "camera.yaml").unlink()
    return sequence


def test_a_sequence_without_a_camera_has_that_of_the_map(
    run_folder: Path, without_camera: Path, tmp_path: Path
) -> None:
    done = call("localize", "--map", run_folder, without_camera, "-o", tmp_path / "found", "--max-frames", 4)
    assert done.returncode == 0, done.stderr
    assert "unknown" not in done.stderr
    notes = json.loads((tmp_path / "found" / "localized.json").read_text())["notes"]
    assert any("intrinsics are those of the map, since those of the sequence are guessed" in n for n in notes)


def test_a_run_in_a_map_has_its_camera_where_the_recording_tells_none(
    run_folder: Path, without_camera: Path, tmp_path: Path
) -> None:
    options = ("--depth", "sensor", "--no-mesh", "--max-frames", 20, "--map-images")
    done = call("run", without_camera, "--map", run_folder, "-o", tmp_path / "again", *options)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "again" / "report.json").read_text())
    saved, own = Map.load(run_folder).camera, Map.load(tmp_path / "again").camera
    assert (own.fx, own.fy, own.cx, own.cy) == (saved.fx, saved.fy, saved.cx, saved.cy)
    assert (report["camera"]["certainty"], report["camera"]["source"]) == ("given", "the map's camera")
    assert any("intrinsics are those of the map" in note for note in report["notes"])
    assert "finding the focal length" not in done.stderr
    assert "unknown" not in done.stderr
    asked = call("run", without_camera, "--map", run_folder, "-o", tmp_path / "fov", *options, "--fov", 70)
    assert asked.returncode == 0, asked.stderr
    report = json.loads((tmp_path / "fov" / "report.json").read_text())
    assert "--fov 70" in report["camera"]["source"]


def test_one_image_is_placed_with_the_camera_of_the_map(
    run_folder: Path, tiny_room: Path, tmp_path: Path
) -> None:
    done = call("localize", "--map", run_folder / "map", images(tiny_room)[12], "-o", tmp_path / "one")
    assert done.returncode == 0, done.stderr
    assert "position in the map" in done.stdout
    assert "intrinsics are those of the map's camera" in done.stdout
    assert len(read_tum_trajectory(tmp_path / "one" / "trajectory.txt")[0]) == 1
    assert "not aligned" not in done.stdout


def test_an_image_of_another_size_is_said_not_to_be_aligned(
    run_folder: Path, tiny_room: Path, tmp_path: Path
) -> None:
    own = Map.load(run_folder).camera
    image = cv2.imread(str(images(tiny_room)[12]))
    assert image is not None
    cv2.imwrite(str(tmp_path / "small.png"), cv2.resize(image, (own.width // 2, own.height // 2)))
    done = call("localize", "--map", run_folder, tmp_path / "small.png", "-o", tmp_path / "one")
    assert done.returncode == 0, done.stderr
    assert "keypoints are not aligned in the map's images" in done.stdout


def test_one_image_of_a_wide_lens_is_placed(run_folder: Path, tiny_room: Path, tmp_path: Path) -> None:
    own = Map.load(run_folder).camera
    lens = tmp_path / "lens.yaml"
    lens.write_text(  # without alpha the model is a pinhole
        f"model: extended_unified\nwidth: {own.width}\nheight: {own.height}\nfx: {own.fx}\nfy: {own.fy}\n"
        f"cx: {own.cx}\ncy: {own.cy}\ndistortion: [0.0, 1.0]\n"
    )
    out = tmp_path / "one"
    done = call("localize", "--map", run_folder, images(tiny_room)[12], "--camera", lens, "-o", out)
    assert done.returncode == 0, done.stderr
    found, expected = (read_tum_trajectory(place / "trajectory.txt")[0] for place in (out, run_folder))
    assert found.T_world_camera[0] == pytest.approx(expected.T_world_camera[12], abs=0.02)


def test_a_run_goes_on_from_the_map(
    run_folder: Path, tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    out = tmp_path / "more"
    given = ("--map", run_folder, "--depth", "sensor", "--no-mesh")
    done = call("run", tiny_room, *given, "--output", out)
    assert done.returncode == 0, done.stderr
    assert "never" not in done.stdout
    grown = Map.load(out)
    assert [session.name for session in grown.sessions] == ["room", "room"]
    assert len(grown) >= len(Map.load(run_folder))
    report = json.loads((out / "report.json").read_text())
    assert report["options"]["start_map"] is True
    assert report["tracked"] == 40
    assert "that of the map it goes on from" in report["scale"]["sentence"]


def test_images_of_a_map_that_another_camera_took_are_said_to_be_left_out(
    run_folder: Path, tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    lens = (tiny_room / "camera.yaml").read_text().splitlines()
    moved = [
        f"fx: {Map.load(run_folder).camera.fx + 0.5}" if line.startswith("fx:") else line for line in lens
    ]
    (tmp_path / "camera.yaml").write_text("\n".join(moved))
    given = ("--map", run_folder, "--depth", "sensor", "--no-mesh", "--map-images", "--max-frames", 10)
    for camera, is_said in ((tiny_room / "camera.yaml", False), (tmp_path / "camera.yaml", True)):
        out = tmp_path / str(is_said)
        done = call("run", tiny_room, *given, "--camera", camera, "--output", out)
        assert done.returncode == 0, done.stderr
        report = json.loads((out / "report.json").read_text())
        assert any("images of the map" in note for note in report["notes"]) is is_said
        assert Map.load(out).has_images is not is_said


def test_what_cannot_be_used_is_refused_in_one_line(
    run_folder: Path, tiny_room: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    cases = (
        (("localize", "--map", tmp_path / "none", tiny_room), "no such folder"),
        (("localize", "--map", tiny_room, tiny_room), "holds no map"),
        (("localize", "--map", run_folder, tmp_path / "no.mp4"), "no such video file"),
        (("run", tiny_room, "--map", tiny_room, "--depth", "sensor"), "holds no map"),
        (("run", tiny_room, "--map", run_folder, "--odometry", "kiss-icp", "--depth", "sensor"), "kiss-icp"),
        (("run", tiny_room, "--map", run_folder, "--features", "sift", "--depth", "sensor"), "features.name"),
    )
    for given, expected in cases:
        done = call(*given, "--output", out)
        assert done.returncode == 2, done.stdout
        assert done.stderr.count("\n") == 1
        assert expected in done.stderr
        assert not out.exists()
