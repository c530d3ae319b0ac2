# SPDX-License-Identifier: Apache-2.0
"""Runs of sequences whose intrinsics are not given."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from command_line import call, copy_of
from seen_scenes import CAMERA, scene

from slamdepth.backend.self_calibration import Prior
from slamdepth.backend.self_calibration_passes import Pass
from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, camera_of_view
from slamdepth.depth.sensor import SensorDepth
from slamdepth.pipeline.camera import GUESSED_SIGMA, OpeningCamera, check_camera, settle_camera, use_view
from slamdepth.report import CameraFacts
from slamdepth.types import Camera

GUESS = camera_of_view(640, 480, 60.0)
GUESSED = CameraSource(Certainty.GUESSED, "a guess")


@pytest.fixture(scope="module")
def without_camera(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    sequence = copy_of(tiny_room, tmp_path_factory.mktemp("no-camera") / "walk")
    (sequence / "camera.yaml").unlink()
    return sequence


def test_a_run_without_a_camera_finds_it_and_says_how(
    without_camera: Path, tiny_room: Path, tmp_path: Path
) -> None:
    done = call("run", without_camera, "--depth", "sensor", "--no-mesh", "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    camera = json.loads((tmp_path / "out" / "report.json").read_text())["camera"]
    true = open_dataset(tiny_room).camera
    assert (camera["width"], camera["height"], camera["certainty"]) == (320, 240, "guessed")
    assert camera["sigma"]["relative"] > 0
    assert "60 degrees across the longer side" in camera["source"]
    if camera["observed"]:
        assert abs(camera["fx"] / true.fx - 1) < 3 * camera["sigma"]["relative"]
    assert "camera" in done.stdout
    assert camera["sentence"] in (tmp_path / "out" / "report.html").read_text()
    again = call("run", without_camera, "--depth", "sensor", "--no-mesh", "--output", tmp_path / "again")
    assert again.returncode == 0, again.stderr
    for file in ("trajectory.txt", "trajectory_online.txt"):
        assert (tmp_path / "out" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


def test_a_given_camera_is_not_looked_for(tiny_room: Path) -> None:
    dataset = open_dataset(tiny_room)
    camera = dataset.camera
    none = threading.Event()
    opening = settle_camera(dataset, range(40), SensorDepth(), Config(), lambda state: None, none)
    assert opening == OpeningCamera(dataset.camera_source)
    facts = check_camera(dataset, opening, None)
    assert (dataset.camera, facts.best, facts.sigma_log_f) == (camera, camera, None)
    assert facts.to_dict()["sigma"] is None
    assert not facts.is_a_guess


def test_a_view_is_nominal_and_overrules_a_file(tiny_room: Path) -> None:
    dataset = open_dataset(tiny_room)
    depth_factor = dataset.camera.depth_factor
    use_view(dataset, 90.0)
    assert dataset.camera.fx == pytest.approx(160.0)
    assert dataset.camera.depth_factor == depth_factor
    assert dataset.camera_source == CameraSource(Certainty.NOMINAL, "--fov 90")


def test_other_odometry_keeps_the_guess(without_camera: Path) -> None:
    dataset = open_dataset(without_camera)
    guess = dataset.camera
    config = Config.from_dict({"odometry": "kiss-icp"})
    opening = settle_camera(dataset, range(40), SensorDepth(), config, lambda state: None, threading.Event())
    facts = check_camera(dataset, opening, None)
    assert dataset.camera == guess
    assert facts.is_a_guess
    assert "give --fov or --camera" in facts.sentence


def test_an_interrupted_search_finds_nothing_out(
    without_camera: Path, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = open_dataset(without_camera)
    guess = dataset.camera
    stop = threading.Event()
    stop.set()
    with caplog.at_level("INFO"):
        opening = settle_camera(dataset, range(20), SensorDepth(), Config(), lambda _: None, stop)
    assert dataset.camera == guess
    assert opening.sigma_log_f == GUESSED_SIGMA
    assert "interrupted before the focal length was found" in caplog.text
    assert "does not show" not in caplog.text


def test_what_the_motion_does_not_show_is_said() -> None:
    opening = OpeningCamera(GUESSED, Prior(GUESS.fx, 0.35), 0.35)
    facts = CameraFacts(GUESS, opening.source, replace(GUESS, fx=700.0, fy=700.0), 0.35)
    assert facts.best == GUESS
    assert facts.is_a_guess
    assert "± 35 %" in facts.sentence
    nominal = replace(facts, source=CameraSource(Certainty.NOMINAL, "--fov 60"), sigma_log_f=0.05)
    assert not nominal.is_a_guess
    assert "no better" in nominal.sentence


def test_a_camera_and_a_view_exclude_each_other(tiny_room: Path) -> None:
    done = call("run", tiny_room, "--camera", tiny_room / "camera.yaml", "--fov", "60", "--depth", "sensor")
    assert done.returncode == 2
    assert "exclude each other" in done.stderr


def final_camera(opening: OpeningCamera, tracked: Camera, monkeypatch: pytest.MonkeyPatch) -> CameraFacts:
    """The camera of a run whose map was tracked with ``tracked``; the true focal length is 480 px."""
    dataset = SimpleNamespace(camera=tracked, notes=[])
    monkeypatch.setattr("slamdepth.tracking.tracker.sights_seen", lambda tracker: scene())
    return check_camera(cast("Dataset", dataset), opening, None)


def test_a_map_that_agrees_with_its_guess_is_not_believed_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked = replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
    prior = Prior(GUESS.fx, GUESSED_SIGMA)
    log_f = math.log(CAMERA.fx)
    for opening in (
        (),
        (Pass(log_f, log_f, 0.005), Pass(log_f + 0.01, log_f, 0.005)),
        (Pass(log_f + 0.35, log_f + 0.33, 0.005), Pass(log_f - 0.3, log_f - 0.29, 0.005)),
    ):
        facts = final_camera(OpeningCamera(GUESSED, prior, GUESSED_SIGMA, opening), tracked, monkeypatch)
        assert not facts.is_observed
        assert facts.sigma_log_f == GUESSED_SIGMA
        assert facts.best == tracked


def test_windows_from_far_starts_let_a_map_be_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = Prior(GUESS.fx, GUESSED_SIGMA)
    log_f = math.log(CAMERA.fx)
    passes = (
        Pass(math.log(GUESS.fx), log_f, 0.005),
        Pass(log_f, log_f, 0.005),
        Pass(log_f + 0.35, log_f, 0.005),
    )
    facts = final_camera(OpeningCamera(GUESSED, prior, 0.04, passes), CAMERA, monkeypatch)
    assert facts.is_observed
    assert facts.sigma_log_f is not None
    assert 0.02 <= facts.sigma_log_f < 0.04
    assert abs(math.log(facts.best.fx / CAMERA.fx)) < facts.sigma_log_f
