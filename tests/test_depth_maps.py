# SPDX-License-Identifier: Apache-2.0
"""Depth maps in files: what is written, what it says of itself, and going on after a stop."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import ENVIRONMENT, call, command, make_long
from sequences import CAMERA, image_rgb, make_tum, write_image

from slamdepth.datasets import write_camera
from slamdepth.depth import registry
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError, InputError, OutputError
from slamdepth.pipeline.depth_maps import DepthMapOptions, DepthMapsInterrupted, make_depth_maps
from slamdepth.pipeline.depth_maps.about import public_name
from slamdepth.report.depth_map import coloured
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

SEEN: list[int] = []


class Ramp:
    """Depth from 1 m at the left to 3 m at the right, 70 m in one corner; counts its calls."""

    def __init__(self, name: str, kind: DepthKind) -> None:
        self.name, self.kind = name, kind
        self.weights = (WeightsInfo(f"{name}-weights", "ab" * 32, "nothing", "none"),)

    def predict(self, frame: Frame) -> DepthPrediction:
        SEEN.append(frame.index)
        height, width = frame.image_rgb.shape[:2]
        values = np.tile(np.linspace(1.0, 3.0, width, dtype=np.float32), (height, 1))
        values[0, 0] = 70.0
        values[0, 1] = 0.0
        return DepthPrediction(values, self.kind)


@pytest.fixture(autouse=True)
def models(monkeypatch: pytest.MonkeyPatch) -> None:
    SEEN.clear()
    for kind in DepthKind:
        name = f"ramp {kind.value}"
        factory: Any = lambda *, device, seed, n=name, k=kind: Ramp(n, k)  # noqa: E731
        monkeypatch.setitem(registry.MODELS.parts, name, factory)


METRIC = f"ramp {DepthKind.METRIC.value}"
INVERSE = f"ramp {DepthKind.AFFINE_INVERSE_DEPTH.value}"


def make(source: Path, output: Path, depth: str = METRIC, **options: Any) -> dict[str, Any]:
    return make_depth_maps(DepthMapOptions(source, output, depth, **options)).about


def photos(folder: Path, count: int = 3, side: tuple[int, int] = (64, 48)) -> Path:
    for i in range(count):
        rng = np.random.default_rng(i)
        write_image(folder / f"p{i + 8}.png", rng.integers(0, 256, (side[1], side[0], 3), dtype=np.uint8))
    return folder


def video(path: Path, count: int = 6) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    return path


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


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
    millimetres = cv2.imread(str(out / "p8.depth-mm.png"), cv2.IMREAD_UNCHANGED)
    assert millimetres.dtype == np.uint16
    assert millimetres[0, 0] == millimetres[0, 1] == 0  # beyond, and unknown
    np.testing.assert_array_equal(millimetres[1:], np.rint(values[1:].astype(np.float64) * 1000))
    assert "1 pixels of 1 image lie beyond 65.535 m and are 0" in about["notes"][0]
    colour = cv2.imread(str(out / "p8.colour.png"))
    assert colour.shape[0] > 48
    assert colour.shape[1] == 64
    header, points = points_of(out / "p8.cloud.ply")
    assert len(points) == 64 * 48 - 1
    fx = 32 / np.tan(np.radians(30))
    row, column = 20, 50
    found = points[row * 64 + column - 1]
    z = values[row, column]
    np.testing.assert_allclose(found["xyz"], [(column - 31.5) / fx * z, (row - 23.5) / fx * z, z], rtol=1e-5)
    source = cv2.imread(str(tmp_path / "in" / "p8.png"))
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
    colour = cv2.imread(str(out / "colour" / "p8.colour.png"))[10, :, ::-1].astype(int)
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


def test_only_what_is_missing_is_predicted_again(tmp_path: Path) -> None:
    folder, out = photos(tmp_path / "in", 4), tmp_path / "out"
    make(folder, out)
    before = {name: (out / name).read_bytes() for name in files(out)}
    SEEN.clear()
    make(folder, out)
    assert SEEN == []
    assert {name: (out / name).read_bytes() for name in files(out)} == before
    (out / "cloud" / "p9.cloud.ply").unlink()
    write_image(folder / "p10.png", image_rgb(7))
    make(folder, out)
    assert SEEN == [1, 2]
    assert np.load(out / "depth-metres" / "p10.depth-metres.npy").shape == (12, 16)


@pytest.mark.parametrize("after", [1, 4, 8])
def test_a_stopped_video_goes_on_to_the_same_bytes(after: int, tmp_path: Path) -> None:
    """Stopped while predicting, between the passes, and while drawing."""
    source = video(tmp_path / "v.mp4")
    make(source, tmp_path / "whole")
    stop, calls = threading.Event(), []

    def count(*state: object) -> None:
        calls.append(state)
        if len(calls) == after:
            stop.set()

    out = tmp_path / "out"
    options = DepthMapOptions(source, out, METRIC)
    with pytest.raises(DepthMapsInterrupted, match="the same command goes on") as stopped:
        make_depth_maps(options, progress=count, stop=stop)
    assert stopped.value.exit_code == 130
    assert json.loads((out / "depth.json").read_text())["complete"] is False
    done = min(after, 6)
    with (out / "frames.jsonl").open("a") as journal:
        journal.write('{"name": "frame-0000')  # as a kill leaves it
    SEEN.clear()
    assert make_depth_maps(options).about["complete"] is True
    assert list(range(done, 6)) == SEEN
    for name in files(tmp_path / "whole"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def test_more_frames_of_a_video_can_be_asked_for_later(tmp_path: Path) -> None:
    source = video(tmp_path / "v.mp4")
    make(source, tmp_path / "out", max_frames=2)
    SEEN.clear()
    assert make(source, tmp_path / "out")["video"]["frames"] == 6
    assert SEEN == [2, 3, 4, 5]


def test_other_settings_need_overwrite(tmp_path: Path) -> None:
    folder, out = photos(tmp_path / "in"), tmp_path / "out"
    make(folder, out)
    (out / "mine.txt").write_text("kept")
    with pytest.raises(ConfigError, match=r"made with 'point clouds' true, now false; .*--overwrite"):
        make(folder, out, cloud=False)
    with pytest.raises(ConfigError, match="made with 'depth model' ramp metric depth, now ramp affine inv"):
        make(folder, out, INVERSE)
    make(folder, out, INVERSE, overwrite=True)
    assert not (out / "cloud").exists()
    assert not list(out.rglob("*metres*"))
    assert (out / "mine.txt").read_text() == "kept"


def test_another_sequence_of_the_same_name_is_another(tmp_path: Path) -> None:
    """All of 7-Scenes are called seq-NN."""
    chess, fire = (tmp_path / scene / "seq-01" for scene in ("chess", "fire"))
    out = tmp_path / "out"
    make(make_tum(chess, 3), out, "sensor")
    with pytest.raises(ConfigError, match=r"made with 'source' .*seq-01 \(.*now .*seq-01 \(.*--overwrite"):
        make(make_tum(fire, 4), out, "sensor")
    assert make(chess, out, "sensor")["frames"] == 3


def test_a_fixed_range_colours_all_alike(tmp_path: Path) -> None:
    out = tmp_path / "out"
    make(photos(tmp_path / "in", 1), out, colour_range=(0.0, 10.0))
    values = np.load(out / "depth-metres" / "p8.depth-metres.npy")
    from slamdepth.report.depth_map import Scale

    expected = coloured(values, Scale(0.0, 10.0, DepthKind.METRIC))
    np.testing.assert_array_equal(cv2.imread(str(out / "colour" / "p8.colour.png"))[:48, :, ::-1], expected)
    with pytest.raises(ConfigError, match="no range in metres"):
        make(tmp_path / "in", tmp_path / "other", INVERSE, colour_range=(0.0, 10.0))


def test_a_sequence_brings_camera_and_sensor(tmp_path: Path) -> None:
    about = make(make_tum(tmp_path / "seq"), tmp_path / "out", "sensor", max_frames=3)
    assert about["scale"] == "metric, measured by the depth sensor"
    assert about["frames"] == 3
    assert (tmp_path / "out" / "side-by-side.mp4").stat().st_size > 0
    raw = cv2.imread(str(tmp_path / "seq" / "depth" / "0.png"), cv2.IMREAD_UNCHANGED)
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


def test_a_full_disk_is_reported_after_the_first_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from types import SimpleNamespace

    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(OutputError, match="GB free; leave out the point clouds"):
        make(photos(tmp_path / "in"), tmp_path / "out")
    assert SEEN == [0]


@pytest.mark.parametrize(
    ("cloud", "said"), [(True, r"--no-cloud leaves out \d\d% of that"), (False, "--stride and --max-frames")]
)
def test_many_gigabytes_are_reported_after_the_first_image(
    cloud: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    source = photos(tmp_path / "in")
    make(source, tmp_path / "small", cloud=cloud)
    assert "GB" not in caplog.text
    monkeypatch.setattr("slamdepth.pipeline.depth_maps.job._MUCH_BYTES", 1000)
    about = make(source, tmp_path / "large", cloud=cloud)
    (warning,) = [record.getMessage() for record in caplog.records if "GB" in record.getMessage()]
    assert re.fullmatch(
        rf"{about['frames'] - 1} images? still to do, about .* GB, .* GB free; {said}.*", warning
    )


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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_is_one_line_and_code_130(number: signal.Signals, tiny_room: Path, tmp_path: Path) -> None:
    room, out = make_long(tiny_room, tmp_path / "room", repeats=40), tmp_path / "out"
    process = subprocess.Popen(
        command("depth", room, "--depth", "sensor", "--output", out, "--no-cloud", "--quiet"),
        env=ENVIRONMENT,
        stderr=subprocess.PIPE,
        text=True,
    )
    journal = out / "frames.jsonl"
    while process.poll() is None and not (journal.exists() and journal.read_text().count("\n") > 3):
        time.sleep(0.01)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=600)
    assert process.returncode == 130, stderr
    assert stderr.startswith("error: interrupted while predicting: ")
    assert stderr.count("\n") == 1
    done = [json.loads(line)["name"] for line in journal.read_text().splitlines()]
    assert len(list((out / "depth-metres").glob("*.npy"))) == len(done) > 3


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
