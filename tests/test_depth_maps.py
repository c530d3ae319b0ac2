# SPDX-License-Identifier: Apache-2.0
"""Depth maps in files: what is written, and what the files say about it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import call
from depth_map_models import INVERSE, METRIC, files, make, photos, register_ramps, video
from sequences import CAMERA, image_rgb, imread, make_tum, write_image

from slamdepth.datasets import write_camera
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError, InputError, OutputError
from slamdepth.pipeline.depth_maps import DepthMapOptions, make_depth_maps
from slamdepth.pipeline.depth_maps.about import public_name
from slamdepth.report.depth_map import coloured
from slamdepth.types import DepthKind


@pytest.fixture(autouse=True)
def models(monkeypatch: pytest.MonkeyPatch) -> None:
    register_ramps(monkeypatch)


def points_of(path: Path) -> tuple[str, np.ndarray]:
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    dtype = [("xyz", "<f4", 3), ("rgb", "u1", 3)]
    return data[:end].decode("ascii"), np.frombuffer(data[end:], dtype)


def test_one_image_gets_every_form_and_they_agree(tmp_path: Path) -> None:
    photos(tmp_path / "in", 1)
    out = tmp_path / "out"
    about = make(tmp_path / "in" / "p8.png", out)
    names = "p8.colour.png p8.depth-mm.png p8.depth-metres.npy p8.cloud.ply"
    assert files(out) == {*names.split(), "README.txt", "depth.json", "frames.jsonl"}
    values = np.load(out / "p8.depth-metres.npy")
    assert values.dtype == np.float32
    assert values.shape == (48, 64)
    millimetres = imread(out / "p8.depth-mm.png", cv2.IMREAD_UNCHANGED)
    assert millimetres.dtype == np.uint16
    assert millimetres[0, 0] == millimetres[0, 1] == 0  # beyond, and unknown
    np.testing.assert_array_equal(millimetres[1:], np.rint(values[1:].astype(np.float64) * 1000))
    assert "1 pixels of 1 image lie beyond 65.535 m and are 0" in about["notes"][0]
    colour = imread(out / "p8.colour.png")
    assert colour.shape[0] > 48
    assert colour.shape[1] == 64
    header, points = points_of(out / "p8.cloud.ply")
    assert len(points) == 64 * 48 - 1
    fx = 32 / np.tan(np.radians(30))
    row, column = 20, 50
    found = points[row * 64 + column - 1]
    z = values[row, column]
    np.testing.assert_allclose(found["xyz"], [(column - 31.5) / fx * z, (row - 23.5) / fx * z, z], rtol=1e-5)
    source = imread(tmp_path / "in" / "p8.png")
    np.testing.assert_array_equal(found["rgb"], source[row, column, ::-1])
    assert "a guess: 60 degrees" in header


def test_a_guessed_focal_length_is_named_everywhere(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    about = make(photos(tmp_path / "in"), tmp_path / "out")
    assert [group["certainty"] for group in about["intrinsics"]] == ["guessed"]
    assert "metres rest on a guess" in about["scale"]
    assert "a guess: 60 degrees" in (tmp_path / "out" / "README.txt").read_text()
    assert "a guess: 60 degrees" in caplog.text


@pytest.mark.parametrize("in_folder", [True, False])
def test_a_camera_file_ends_the_guess(in_folder: bool, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    write_image(folder / "a.png", image_rgb(0))
    camera_file = (folder if in_folder else tmp_path) / "camera.yaml"
    write_camera(camera_file, CAMERA)
    about = make(folder, tmp_path / "out", camera_file=None if in_folder else camera_file)
    (group,) = about["intrinsics"]
    assert (group["fx"], group["certainty"]) == (20.0, "given")
    assert "guess" not in about["scale"]
    assert str(tmp_path) not in (tmp_path / "out" / "depth.json").read_text()


def test_a_lens_distortion_is_undone_in_the_cloud(tmp_path: Path) -> None:
    from dataclasses import replace

    camera = replace(CAMERA, distortion=(0.2, 0.0, 0.0, 0.0, 0.0))
    write_image(tmp_path / "in" / "a.png", image_rgb(0))
    write_camera(tmp_path / "in" / "camera.yaml", camera)
    make(tmp_path / "in", tmp_path / "out")
    _, points = points_of(tmp_path / "out" / "cloud" / "a.cloud.ply")
    last = points["xyz"][-1]
    expected = camera.undistort_points(np.array([[15.0, 11.0]]))[0]
    np.testing.assert_allclose(last[0] / last[2] * 20.0 + 7.5, expected[0], rtol=1e-5)
    assert abs(expected[0] - 15.0) > 0.1


def test_relative_depth_gets_no_metres(tmp_path: Path) -> None:
    out = tmp_path / "out"
    about = make(photos(tmp_path / "in", 1), out, INVERSE)
    kinds = {"colour/p8.colour.png", "relative-inverse-depth/p8.relative-inverse-depth.npy"}
    assert files(out) == {*kinds, "README.txt", "depth.json", "frames.jsonl"}
    assert about["unit"] == "relative, no unit"
    assert "known up to a scale and an offset" in about["scale"]
    readme = (out / "README.txt").read_text()
    assert "metres" not in readme
    colour = imread(out / "colour" / "p8.colour.png")[10, :, ::-1].astype(int)
    assert colour[0].sum() > 2 * colour[-1].sum()  # small inverse depth is far, so bright


def test_a_video_keeps_one_range_and_a_folder_does_not(tmp_path: Path) -> None:
    out = tmp_path / "maps"
    about = make(video(tmp_path / "v.mp4"), out, stride=2)
    assert about["frames"] == 3
    assert about["source"]["frames_per_second"] == pytest.approx(5.0)
    assert (about["colours"]["near"], about["colours"]["far"]) == pytest.approx((1.0, 3.0), abs=0.04)
    capture = cv2.VideoCapture(str(out / "side-by-side.mp4"))
    shapes = []
    while (got := capture.read())[0]:
        shapes.append(got[1].shape)
    assert len(shapes) == 3
    assert shapes[0][1] == 2 * 64 + 4
    assert {f"colour/frame-{i:06d}.colour.png" for i in (0, 2, 4)} <= files(out)
    assert "side-by-side.mp4" not in files(make_and_get(tmp_path))


def make_and_get(tmp_path: Path) -> Path:
    make(photos(tmp_path / "in"), tmp_path / "folder")
    return tmp_path / "folder"


def test_broken_and_odd_images_are_noted_skips(tmp_path: Path) -> None:
    folder = photos(tmp_path / "in")
    whole = (folder / "p9.png").read_bytes()
    (folder / "p9.png").write_bytes(whole[:200])
    (folder / "p9.jpg").write_bytes(b"")
    about = make(folder, tmp_path / "out")
    assert about["frames"] == 2
    assert [one["origin"] for one in about["skipped"]] == ["p9.jpg", "p9.png"]
    assert "left out: 2 images" in about["notes"][0]
    for path in folder.glob("p*.png"):
        path.write_bytes(b"")
    with pytest.raises(DatasetError, match="not one image could be used; the first: p8"):
        make(folder, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_names_that_differ_in_the_ending_alone_stay_apart(tmp_path: Path) -> None:
    for name in ("a.png", "A.JPG", "b2.png", "b10.png"):
        write_image(tmp_path / "in" / name.lower(), image_rgb(1))
    (tmp_path / "in" / "a.jpg").rename(tmp_path / "in" / "A.JPG")
    make(tmp_path / "in", tmp_path / "out")
    lines = (tmp_path / "out" / "frames.jsonl").read_text().splitlines()
    assert [json.loads(line)["name"] for line in lines] == ["A.JPG", "a.png", "b2", "b10"]


def test_a_fixed_range_colours_all_alike(tmp_path: Path) -> None:
    out = tmp_path / "out"
    make(photos(tmp_path / "in", 1), out, colour_range=(0.0, 10.0))
    values = np.load(out / "depth-metres" / "p8.depth-metres.npy")
    from slamdepth.report.depth_map import Scale

    expected = coloured(values, Scale(0.0, 10.0, DepthKind.METRIC))
    np.testing.assert_array_equal(imread(out / "colour" / "p8.colour.png")[:48, :, ::-1], expected)
    with pytest.raises(ConfigError, match="no range in metres"):
        make(tmp_path / "in", tmp_path / "other", INVERSE, colour_range=(0.0, 10.0))


def test_a_sequence_brings_camera_and_sensor(tmp_path: Path) -> None:
    about = make(make_tum(tmp_path / "seq"), tmp_path / "out", "sensor", max_frames=3)
    assert about["scale"] == "metric, measured by the depth sensor"
    assert about["frames"] == 3
    assert (tmp_path / "out" / "side-by-side.mp4").stat().st_size > 0
    raw = imread(tmp_path / "seq" / "depth" / "0.png", cv2.IMREAD_UNCHANGED)
    values = np.load(tmp_path / "out" / "depth-metres" / "frame-000000.depth-metres.npy")
    np.testing.assert_allclose(values, raw / 5000.0, rtol=1e-6)


def test_depth_images_of_training_pairs_are_no_colour_images(tmp_path: Path) -> None:
    about = make(pairs(tmp_path / "place"), tmp_path / "out")
    assert about["frames"] == 2
    assert about["intrinsics"][0]["how"] == "camera.json of the pairs"


def pairs(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for i in range(2):
        write_image(folder / f"0000{i}.jpg", image_rgb(i))
        write_image(folder / f"0000{i}.png", np.full((12, 16), 1000 * i, np.uint16))
    (folder / "camera.json").write_text('{"width":16,"height":12,"fx":20,"fy":20,"cx":7.5,"cy":5.5}')
    return folder


def test_bad_input_is_one_clear_error_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.mp4").write_bytes(b"no video at all")
    (tmp_path / "notes.txt").write_text("hello")
    foreign = photos(tmp_path / "foreign")
    cases: list[tuple[Path, dict[str, Any], type[InputError], str]] = [
        (tmp_path / "nothing", {}, DatasetError, "no such file or folder"),
        (tmp_path / "empty", {}, DatasetError, "no images in it"),
        (tmp_path / "bad.mp4", {}, DatasetError, "no video that can be read"),
        (tmp_path / "notes.txt", {}, DatasetError, "neither a folder nor an image nor a video"),
        (foreign, {"depth": "sensor"}, DatasetError, "no sensor depth"),
        (foreign, {"output": foreign}, OutputError, "holds no earlier depth maps"),
        (foreign, {"output": tmp_path / "notes.txt"}, OutputError, "is a file"),
        (foreign, {"stride": 0}, ConfigError, "stride"),
        (foreign, {"colour_range": (3.0, 1.0)}, ConfigError, "must rise"),
        (foreign, {"weights": tmp_path / "notes.txt"}, ConfigError, "takes no weights file"),
    ]
    for source, options, error, words in cases:
        with pytest.raises(error, match=words):
            make_depth_maps(DepthMapOptions(**{"source": source, "output": out, "depth": METRIC, **options}))
    assert not out.exists()
    assert len(list(foreign.iterdir())) == 3


def test_images_far_apart_are_shown_for_a_second_each(tmp_path: Path) -> None:
    make(video(tmp_path / "v.mp4", count=6), tmp_path / "out", stride=100_000)
    made = cv2.VideoCapture(str(tmp_path / "out" / "side-by-side.mp4"))
    assert made.get(cv2.CAP_PROP_FPS) == 1.0
    assert made.read()[0]


def test_the_command_says_what_it_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    sequence, out = make_tum(tmp_path / "seq"), tmp_path / "out"
    done = call("depth", sequence, "--depth", "sensor", "--output", out, "--range", 0, 6, "--no-cloud")
    assert done.returncode == 0, done.stderr
    assert "metric, measured by the depth sensor" in done.stdout
    assert not (out / "cloud").exists()
    again = call("depth", sequence, "--depth", "sensor", "--output", out, "--stride", 2)
    assert again.returncode == 2
    assert "made with 'stride' 1, now 2" in again.stderr
    assert again.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "public"),
    [
        ("mirrored:dinov2", "mirrored:dinov2"),
        ("onnx:/home/a:b/net.onnx", "onnx:net.onnx"),
        ("mirrored:onnx:/home/a:b/net.onnx", "mirrored:onnx:net.onnx"),
    ],
)
def test_a_models_public_name_has_no_folder(name: str, public: str) -> None:
    model = SensorDepth()
    model.name = name
    assert public_name(model) == public
