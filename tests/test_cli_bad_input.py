# SPDX-License-Identifier: Apache-2.0
"""Bad input: one line on standard error, exit code 2, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call, copy_of, images, replace_image

RUN = ("run", "SEQ", "--depth", "sensor", "--output", "OUT")


def no_list(sequence: Path) -> None:
    (sequence / "rgb.txt").unlink()


def empty_list(sequence: Path) -> None:
    (sequence / "rgb.txt").write_text("# nothing\n")


def malformed_list(sequence: Path) -> None:
    lines = (sequence / "rgb.txt").read_text().splitlines()
    lines[3] = "what is this"
    (sequence / "rgb.txt").write_text("\n".join(lines))


def times_that_go_back(sequence: Path) -> None:
    lines = (sequence / "rgb.txt").read_text().splitlines()
    lines[4], lines[5] = lines[5], lines[4]
    (sequence / "rgb.txt").write_text("\n".join(lines))


def all_images_broken(sequence: Path) -> None:
    for path in images(sequence):
        replace_image(path, b"no image")


def most_images_broken(sequence: Path) -> None:
    for path in images(sequence)[5:]:
        replace_image(path, b"no image")


def one_image_of_another_size(sequence: Path) -> None:
    replace_image(images(sequence)[5], cv2.imencode(".png", np.zeros((100, 100, 3), np.uint8))[1].tobytes())


def camera_of_another_size(sequence: Path) -> None:
    text = (sequence / "camera.yaml").read_text()
    (sequence / "camera.yaml").write_text(text.replace("width: 320", "width: 640"))


def camera_malformed(sequence: Path) -> None:
    (sequence / "camera.yaml").write_text("width: 320\n")


def ground_truth_of_another_day(sequence: Path) -> None:
    (sequence / "groundtruth.txt").write_text("99999.0 0 0 0 0 0 0 1\n")


def ground_truth_malformed(sequence: Path) -> None:
    (sequence / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n0.1 0 0\n")


def no_depth(sequence: Path) -> None:
    (sequence / "depth.txt").unlink()


BAD_SEQUENCES: list[tuple[Callable[[Path], None], str]] = [
    (no_list, "rgb.txt"),
    (empty_list, "rgb.txt: lists no images"),
    (malformed_list, "rgb.txt:4: expected 'timestamp filename'"),
    (times_that_go_back, "rgb.txt:6: time"),
    (all_images_broken, "none of the 40 images decodes"),
    (most_images_broken, "more than half of the images do not decode"),
    (one_image_of_another_size, "the image is 100x100, the camera says 320x240"),
    (camera_of_another_size, "the image is 320x240, the camera says 640x240"),
    (camera_malformed, "camera.yaml: keys height, fx, fy, cx, cy missing"),
    (ground_truth_of_another_day, "groundtruth.txt: no pose within"),
    (ground_truth_malformed, "groundtruth.txt:2: expected eight numbers"),
    (no_depth, "no sensor depth"),
]


def assert_one_line(stderr: str, expected: str) -> None:
    errors = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, stderr
    assert expected in errors[0]
    assert "Traceback" not in stderr


@pytest.mark.parametrize(
    ("spoil", "expected"), BAD_SEQUENCES, ids=[case[0].__name__ for case in BAD_SEQUENCES]
)
def test_bad_sequences(spoil: Callable[[Path], None], expected: str, tiny_room: Path, tmp_path: Path) -> None:
    sequence = copy_of(tiny_room, tmp_path / "room")
    spoil(sequence)
    done = call("run", sequence, "--depth", "sensor", "--output", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    assert_one_line(done.stderr, expected)
    assert not (tmp_path / "out").exists()
    assert done.stdout == ""


def test_a_sequence_that_shows_nothing(tiny_room: Path, tmp_path: Path) -> None:
    sequence = copy_of(tiny_room, tmp_path / "room")
    black = cv2.imencode(".png", np.zeros((240, 320, 3), np.uint8))[1].tobytes()
    for path in images(sequence):
        replace_image(path, black)
    done = call("run", sequence, "--depth", "sensor", "--output", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    assert_one_line(done.stderr, "no frame could be placed")
    assert not (tmp_path / "out").exists()


BAD_CALLS = {
    "missing folder": (("run", "/no/such/folder", "--depth", "sensor"), "/no/such/folder: no such folder"),
    "a file": (("run", __file__, "--depth", "sensor"), "is a file; a sequence is a folder or a video (mp4, "),
    "no sequence": (("run",), "Missing argument 'SEQ'"),
    "unknown option": (("run", "SEQ", "--dept", "sensor"), "No such option: --dept"),
    "unknown command": (("rum", "SEQ"), "No such command 'rum'"),
    "unknown depth model": ((*RUN, "--depth", "kinect"), "unknown depth model 'kinect'; choose from: "),
    "unknown odometry": ((*RUN, "--odometry", "wheels"), "'orb' or 'kiss-icp'"),
    "unknown feature": (
        (*RUN, "--features", "surf"),
        "no feature is called 'surf'; known: akaze, aliked, brisk, orb, sift",
    ),
    "features without a file": ((*RUN, "--features", "aliked"), "with --features-weights FILE"),
    "features with a wrong file": (
        (*RUN, "--features", "aliked", "--features-weights", "FILE"),
        "takes nothing, not 'image' (1, 3, rows, columns) as ALIKED does",
    ),
    "features not used": (
        (*RUN, "--odometry", "kiss-icp", "--features", "sift"),
        "command line: odometry 'kiss-icp' uses no features",
    ),
    "unknown device": ((*RUN, "--device", "tpu"), "'cpu' or 'cuda'"),
    "depth on no device": (
        ("depth", "SEQ", "--device", "gpu", "-o", "OUT"),
        "unknown device 'gpu'; choose from",
    ),
    "scale on no device": (("scale", "SEQ", "--device", "mps"), "unknown device 'mps'; choose from"),
    "eval-depth on no device": (("eval-depth", "dinov2", "SEQ", "--device", ""), "unknown device ''; choose"),
    "train-depth on no device": (
        ("train-depth", "TRAINING", "--dry-run", "--device", "banana"),
        "unknown device 'banana'; choose from: cpu, cuda, cuda:N",
    ),
    "no number": ((*RUN, "--max-frames", "many"), "Invalid value for '--max-frames'"),
    "stride 0": ((*RUN, "--stride", "0"), "Invalid value for '--stride'"),
    "voxel size": ((*RUN, "--voxel-size", "-1"), "map.voxel_size_m"),
    "output is a file": ((*RUN[:-1], "FILE"), "is a file"),
    "output below a file": ((*RUN[:-1], "FILE/out"), "cannot be written"),
    "output of something else": ((*RUN[:-1], "SEQ", "--overwrite"), "holds no earlier run"),
    "missing camera file": ((*RUN, "--camera", "/no/camera.yaml"), "/no/camera.yaml: cannot be read"),
    "missing settings": ((*RUN, "--config", "/no/settings.yaml"), "/no/settings.yaml: cannot read"),
    "unknown setting": ((*RUN, "--config", "UNKNOWN"), "unknown setting 'map.voxel'; allowed here: "),
    "settings no YAML": ((*RUN, "--config", "GARBLED"), "not valid YAML"),
    "evaluate missing": (("evaluate", "/no/a.txt", "/no/b.txt"), "/no/a.txt: cannot be read"),
    "evaluate range": (("evaluate", "GT", "GT", "--max-difference", "0"), "must be positive"),
    "evaluate over another file": (("evaluate", "GT", "GT", "-o", "FILE"), "no .json file; name another"),
    "evaluate at no rate": (("evaluate", "GT", "GT", "--fps", "inf"), "must be positive and finite"),
    "evaluate into a folder": (("evaluate", "GT", "GT", "-o", "BUSY"), "is a folder; name a file"),
    "scale over another file": (("scale", "SEQ", "-o", "FILE"), "no .yaml file; name another"),
    "no estimate": (("evaluate", "GT"), "evaluate [OPTIONS] GROUNDTRUTH ESTIMATE"),
    "range below 0": (("depth", "SEQ", "--range", "-1", "2", "-o", "OUT"), "near (0 or more) to far"),
    "synth range": (("synth", "OUT", "--frames", "1"), "frames"),
    "synth into something else": (("synth", "BUSY"), "is not empty"),
    "unknown weights": (("weights", "pull", "resnet"), "unknown weights 'resnet'; choose from: "),
    "training missing": (("train-depth", "/no/train.yaml"), "/no/train.yaml: cannot read"),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_calls(case: str, tiny_room: Path, tmp_path: Path) -> None:
    arguments, expected = BAD_CALLS[case]
    places = {
        "SEQ": tiny_room,
        "OUT": tmp_path / "out",
        "GT": tiny_room / "groundtruth.txt",
        "BUSY": tmp_path,
        "TRAINING": files("slamdepth") / "training" / "configs" / "dinov2_head.yaml",
    }
    places["FILE"] = tmp_path / "file"
    places["FILE/out"] = tmp_path / "file" / "out"
    unknown, garbled = tmp_path / "unknown.yaml", tmp_path / "garbled.yaml"
    places["UNKNOWN"], places["GARBLED"] = unknown, garbled
    (tmp_path / "file").write_text("")
    unknown.write_text("map: {voxel: 1}\n")
    garbled.write_text("a: [\n")
    before = sorted(tmp_path.iterdir())
    done = call(*(places.get(argument, argument) for argument in arguments))
    assert done.returncode == 2, done.stderr
    assert_one_line(done.stderr, expected)
    assert sorted(tmp_path.iterdir()) == before


def test_predicted_depth_without_weights_says_how_to_get_them(
    tiny_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "empty"))
    done = call("run", tiny_room, "--depth", "dinov2", "--output", tmp_path / "out")
    assert done.returncode == 2
    assert_one_line(done.stderr, "slamdepth weights pull")
    assert not (tmp_path / "out").exists()


def test_a_traceback_is_shown_only_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SLAMDEPTH_DEBUG", raising=False)
    assert "Traceback" not in call("run", "/no/such/folder").stderr
    assert "Traceback" in call("run", "/no/such/folder", "--verbose").stderr
    assert "Traceback" not in call("run", "/no/such/folder").stderr
    monkeypatch.setenv("SLAMDEPTH_DEBUG", "1")
    assert "Traceback" in call("run", "/no/such/folder").stderr
