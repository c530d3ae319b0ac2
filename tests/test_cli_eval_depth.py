# SPDX-License-Identifier: Apache-2.0
"""``slamdepth eval-depth`` on a rendered room and on training pairs, with models that need no weights."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from training_places import make_tum

from slamdepth.depth import registry
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.pipeline.depth_data import open_depth_data, readable, thinned
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame


class _Disparity:
    """Affine inverse depth of the sensor: right after the affine fit alone."""

    name, kind, weights = "made-up", DepthKind.AFFINE_INVERSE_DEPTH, ()

    def __init__(self, *, device: str = "cpu", seed: int = 0) -> None: ...

    def predict(self, frame: Frame) -> DepthPrediction:
        assert frame.depth_m is not None
        known = frame.depth_m > 0
        values = np.where(known, 3.0 / np.where(known, frame.depth_m, 1.0) + 1.0, 0.0)
        return DepthPrediction(values.astype(np.float32), self.kind)


@pytest.fixture
def disparity(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setitem(registry.MODELS.parts, "made-up", _Disparity)
    return "made-up"


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    folder = tmp_path / "corner"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(3):
        cv2.imwrite(str(folder / f"{k:05d}.jpg"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        depth = np.full((48, 64), 1000 + 200 * k, np.uint16)
        depth[:, 32:] = 2500
        cv2.imwrite(str(folder / f"{k:05d}.png"), depth)
    camera = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24, "depth_unit_m": 0.001}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_a_sequence_and_training_pairs_together(tiny_room: Path, pairs: Path, tmp_path: Path) -> None:
    output = tmp_path / "judged.json"
    done = call("eval-depth", "sensor", tiny_room, pairs, "--max-frames", 2, "-o", output)
    assert done.returncode == 0, done.stderr
    assert f"sensor (metric depth) on {tiny_room.name}" in done.stdout
    assert "mean over the 2 data sets" in done.stdout
    figures = json.loads(output.read_text())
    assert set(figures["data"]) == {tiny_room.name, "corner"}
    for judged in figures["data"].values():
        assert judged["frames"] == 2
        assert set(judged["ways"]) == {"as_predicted", "sequence_median", "frame_median", "frame_affine"}
        assert judged["ways"]["as_predicted"]["abs_rel"]["value"] == 0.0
        assert judged["ways"]["as_predicted"]["edge_f1"]["value"] == 1.0
    assert (figures["complete"], figures["not_judged"]) == (True, [])
    assert figures["mean_over_sets"]["as_predicted"]["delta1"] == 1.0
    assert figures["versions"]["slamdepth"]
    for image in ("judged_over_depth.png", f"judged_{tiny_room.name}.png", "judged_corner.png"):
        assert cv2.imread(str(tmp_path / image)) is not None, image
        assert image in done.stdout.replace("\n", "")


def test_a_model_without_metres_is_judged_after_the_fit(disparity: str, pairs: Path, tmp_path: Path) -> None:
    done = call("eval-depth", disparity, pairs, "-o", tmp_path / "judged.json")
    assert done.returncode == 0, done.stderr
    assert "affine inverse depth" in done.stdout
    (abs_rel,) = [line for line in done.stdout.splitlines() if "AbsRel " in line and "surest" not in line]
    assert "–" in abs_rel.split("AbsRel")[1].split("0.")[0]  # as predicted: nothing
    ways = json.loads((tmp_path / "judged.json").read_text())["data"]["corner"]["ways"]
    assert "as_predicted" not in ways
    assert ways["frame_affine"]["abs_rel"]["value"] == pytest.approx(0.0, abs=1e-5)


def test_the_same_folder_twice_keeps_both(pairs: Path, tmp_path: Path) -> None:
    done = call("eval-depth", "sensor", pairs, pairs, "-o", tmp_path / "judged.json")
    assert done.returncode == 0, done.stderr
    assert list(json.loads((tmp_path / "judged.json").read_text())["data"]) == ["corner", "corner-2"]


def test_what_is_wrong_is_one_line(tiny_room: Path, pairs: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments, said in (
        (("sensor", tmp_path / "nowhere"), "no such folder"),
        (("sensor", empty), "no known sequence layout"),
        (("midas", pairs), "unknown depth model 'midas'"),
        (("sensor", pairs, "--depth-weights", "x"), "takes no weights file"),
        (("dinov2", pairs, "--depth-weights", tmp_path / "x"), ""),
        (("sensor", pairs, "--camera", tmp_path / "c.yaml"), "leave out --camera"),
        (("sensor", pairs, "-o", tmp_path / "nowhere" / "x.json"), "no such folder to write to"),
        (("sensor", pairs, "-o", tmp_path), "is a folder; name a file"),
        (("sensor", pairs / "camera.json"), "is a file; name a folder"),
        ((pairs, "sensor"), "the order is 'slamdepth eval-depth MODEL DATA...'"),
        ((pairs,), "eval-depth [OPTIONS] MODEL DATA..."),
    ):
        done = call("eval-depth", *arguments)
        assert done.returncode != 0
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert said in done.stderr


@pytest.mark.parametrize("ending", ["error", "Ctrl-C"])
def test_what_was_judged_before_an_end_is_written(
    ending: str, pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second data set cannot be evaluated, or the user interrupts."""
    second = shutil.copytree(pairs, tmp_path / "second")
    third = shutil.copytree(pairs, tmp_path / "third")
    output = tmp_path / "judged.json"
    raised = ConfigError("made up") if ending == "error" else KeyboardInterrupt()
    predicted: list[int] = []

    def predict(model: SensorDepth, frame: Frame) -> DepthPrediction:
        predicted.append(frame.index)
        if len(predicted) > 3:
            raise raised
        return measure(model, frame)

    measure = SensorDepth.predict
    monkeypatch.setattr(SensorDepth, "predict", predict)
    done = call("eval-depth", "sensor", pairs, second, third, "-o", output)
    figures = json.loads(output.read_text())
    assert list(figures["data"]) == ["corner"]
    assert (figures["complete"], figures["not_judged"]) == (False, ["second", "third"])
    assert (tmp_path / "judged_corner.png").is_file()
    kept = f"{output} has the 1 of 3 data sets evaluated so far"
    if ending == "error":
        assert (done.returncode, done.stderr) == (2, "error: made up\n")
        assert f"figures: {kept}\n" in done.stdout
    else:
        assert (done.returncode, done.stderr) == (130, f"error: interrupted: {kept}\n")
        assert call("eval-depth", "sensor", pairs).stderr == "error: interrupted: nothing was written\n"


def test_figures_of_an_earlier_call_are_replaced(pairs: Path, tmp_path: Path) -> None:
    output = tmp_path / "judged.json"
    for frames in (1, 2):
        done = call("eval-depth", "sensor", pairs, "--max-frames", frames, "-o", output)
        assert done.returncode == 0, done.stderr
        assert json.loads(output.read_text())["data"]["corner"]["frames"] == frames


def test_a_folder_without_depth_is_refused(tmp_path: Path, tiny_room: Path) -> None:
    from command_line import copy_of

    sequence = copy_of(tiny_room, tmp_path / "copy")
    (sequence / "depth.txt").unlink()
    done = call("eval-depth", "sensor", sequence)
    assert done.returncode == 2
    assert "has no sensor depth" in done.stderr


def test_a_folder_of_places_is_several(pairs: Path, tmp_path: Path) -> None:
    shutil.copytree(pairs, tmp_path / "places" / "left")
    shutil.copytree(pairs, tmp_path / "places" / "right")
    done = call("eval-depth", "sensor", tmp_path / "places", "-o", tmp_path / "judged.json")
    assert done.returncode == 0, done.stderr
    assert list(json.loads((tmp_path / "judged.json").read_text())["data"]) == ["left", "right"]


def test_a_folder_that_cannot_be_read_is_left_out_or_named(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("left", "right"):
        shutil.copytree(pairs, tmp_path / "places" / name)
    real = Path.is_file

    def refuse(path: Path) -> bool:
        if path.parent.name == "left":
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(Path, "is_file", refuse)
    assert [place.name for place in open_depth_data(tmp_path / "places")] == ["right"]
    assert "left: left out, cannot be read: Permission denied" in caplog.text
    with pytest.raises(DatasetError, match="left: cannot be read: Permission denied"):
        open_depth_data(tmp_path / "places" / "left")


def test_an_image_of_another_size_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    folder = make_tum(tmp_path / "tum", camera, count=4)
    (place,) = open_depth_data(folder)
    cv2.imwrite(str(folder / "depth" / "2.png"), np.ones((24, 32), np.uint16))
    assert [frame.timestamp_s for frame in readable(place, range(len(place)))] == [1.0, 3.0]
    assert "frame left out: " in caplog.text


def test_a_stride_counts_the_frames_of_the_sequence(tmp_path: Path) -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    (place,) = open_depth_data(make_tum(tmp_path / "tum", camera, count=8))  # frame 0 has no depth
    assert len(place) == 7
    indices = thinned(place, 2)
    assert [frame.timestamp_s for frame in readable(place, indices)] == [2.0, 4.0, 6.0]
    assert thinned(place, 2, max_frames=1) == indices[:1]
    (tmp_path / "tum" / "depth" / "4.png").write_bytes(b"")
    assert [frame.timestamp_s for frame in readable(place, indices)] == [2.0, 6.0]
