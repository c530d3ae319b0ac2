# SPDX-License-Identifier: Apache-2.0
"""Markers of known size: their names, their detection, and the scale they give."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import MadeUpDataset

from slamdepth.config import Config
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.fiducial import FAMILIES, MarkerDetector, MarkerSpec
from slamdepth.geometry import se3_exp, so3_exp
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.pipeline.scale import settle_scale
from slamdepth.report import ScaleSource
from slamdepth.scale.marker import from_markers
from slamdepth.scale.marker_fit import Sighting, fit_marker
from slamdepth.synth.sequence import SynthSettings
from slamdepth.types import Camera, Frame, Trajectory
from slamdepth.typing import Floats

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""Corners seen by a camera that looks along z at the marker, top left first."""


def views(count: int, sideways_m: float) -> Floats:
    """Cameras ``(N, 4, 4)`` on a line of ``sideways_m``, looking at what is one metre ahead."""
    x = np.linspace(-0.5, 0.5, count) * sideways_m
    zero = np.zeros(count)
    return se3_exp(np.stack([x, 0.1 * x, zero, zero, -np.arctan(x), 0.02 * zero], axis=1))


def seen(T_world_camera: Floats, side_m: float, turn: Floats) -> Floats:
    corners = side_m * SQUARE @ so3_exp(turn[None])[0].T + [0.05, -0.03, 1.0]
    points = (corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    return np.asarray(points[:, :2] / points[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy])


def sightings(count: int, sideways_m: float, side_m: float = 0.1, noise_px: float = 0.0) -> list[Sighting]:
    rng = np.random.default_rng(0)
    turn = np.array([0.3, -0.4, 0.2])
    return [
        Sighting(T, seen(T, side_m, turn) + noise_px * rng.standard_normal((4, 2)), n)
        for n, T in enumerate(views(count, sideways_m))
    ]


# --- names ---------------------------------------------------------------------------------


def test_markers_are_named_by_family_side_and_number() -> None:
    assert MarkerSpec.parse("tag36h11:0.16") == MarkerSpec("tag36h11", 0.16)
    assert MarkerSpec.parse("DICT_4X4_50:0.05:7") == MarkerSpec("DICT_4X4_50", 0.05, 7)
    assert all(len(MarkerSpec(family, 0.1).dictionary().bytesList) > 0 for family in FAMILIES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tag36h11", "expected FAMILY:SIDE"),
        ("tag:0.1", "unknown family 'tag'; known: tag16h5"),
        ("tag36h11:big", "must be numbers"),
        ("tag36h11:0", "between 0 and 100 metres"),
        ("tag36h11:nan", "between 0 and 100 metres"),
        ("DICT_4X4_50:0.1:50", "numbers 0 to 49"),
    ],
)
def test_what_names_no_marker_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        MarkerSpec.parse(text)
    with pytest.raises(ConfigError, match=message):
        Config.from_dict({"scale": {"marker": [text]}})
    with pytest.raises(ConfigError, match=message):
        SynthSettings.from_dict({"marker": text})


def test_a_marker_is_refused_before_the_run(tmp_path: Path) -> None:
    done = call("run", tmp_path, "--marker", "tag99:0.1")
    assert done.returncode == 2
    assert "unknown family 'tag99'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    done = call("run", tmp_path, "--imu", tmp_path / "no.csv")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    done = call("synth", tmp_path / "hall", "--scene", "aliased", "--marker", "tag36h11:0.1")
    assert done.returncode == 2
    assert "hangs in the scene 'room' only" in done.stderr


# --- the fit -------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.floats(0.02, 0.3), st.floats(0.1, 1.0), st.integers(0, 1000))
def test_the_side_of_an_exact_marker_is_exact(side_m: float, sideways_m: float, seed: int) -> None:
    turn = 0.8 * np.random.default_rng(seed).uniform(-1, 1, 3)
    found = fit_marker(
        CAMERA, [Sighting(T, seen(T, side_m, turn), n) for n, T in enumerate(views(5, sideways_m))]
    )
    assert found is not None
    assert found.side == pytest.approx(side_m, rel=1e-4)
    np.testing.assert_allclose(found.centre, [0.05, -0.03, 1.0], atol=1e-4)


def test_the_interval_holds_the_truth_and_narrows_with_parallax() -> None:
    off, sigmas = [], []
    for sideways_m in (0.1, 0.3, 0.9):
        found = fit_marker(CAMERA, sightings(12, sideways_m, noise_px=0.3))
        assert found is not None
        off.append(abs(math.log(found.side / 0.1)) / found.sigma_log)
        sigmas.append(found.sigma_log)
    assert max(off) < 3
    assert sigmas == sorted(sigmas, reverse=True)


def test_a_single_wrong_detection_does_little_harm() -> None:
    some = sightings(10, 0.5, noise_px=0.2)
    some[3] = Sighting(some[3].T_world_camera, some[3].corners_px + np.array([30.0, 5.0]), 3)
    found = fit_marker(CAMERA, some)
    assert found is not None
    assert found.side == pytest.approx(0.1, rel=0.01)


# --- images --------------------------------------------------------------------------------


class Wall(MadeUpDataset):
    """Images of a marker on a wall, one metre before the first camera."""

    def __init__(self, poses: Floats, number: int = 3) -> None:
        super().__init__(len(poses))
        self.camera = CAMERA
        self.timestamps_s = np.arange(len(poses)) / 10.0
        self._poses = poses
        spec = MarkerSpec("DICT_4X4_50", 0.2)
        print_ = cv2.aruco.generateImageMarker(spec.dictionary(), number, 240)
        self._print = cv2.copyMakeBorder(print_, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        fine = 4  # pixels of an image that is averaged to this one
        corners = ((seen(self._poses[index], 0.2, np.zeros(3)) + 0.5) * fine - 0.5).astype(np.float32)
        flat = np.array([[39.5, 39.5], [279.5, 39.5], [279.5, 279.5], [39.5, 279.5]], np.float32)
        H = cv2.getPerspectiveTransform(flat, corners)
        large = cv2.warpPerspective(self._print, H, (320 * fine, 240 * fine), borderValue=128)
        grey = cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA)
        image = np.repeat(cv2.GaussianBlur(grey, (0, 0), 0.6)[..., None], 3, axis=2)
        return Frame(
            index, float(self.timestamps_s[index]), np.ascontiguousarray(image, dtype=np.uint8), CAMERA
        )


def mapped(dataset: Wall, scale: float) -> Reconstruction:
    T = dataset._poses.copy()
    T[:, :3, 3] *= scale
    return Reconstruction(Trajectory(dataset.timestamps_s, T), (), np.zeros((0, 3)))


def test_corners_are_found_to_a_fraction_of_a_pixel() -> None:
    dataset = Wall(views(3, 0.4))
    found = MarkerDetector(MarkerSpec("DICT_4X4_50", 0.2)).find(dataset.read(0).image_rgb)
    assert list(found) == [3]
    np.testing.assert_allclose(found[3], seen(dataset._poses[0], 0.2, np.zeros(3)), atol=0.1)
    assert MarkerDetector(MarkerSpec("DICT_4X4_50", 0.2, 8)).find(dataset.read(0).image_rgb) == {}


def test_a_marker_seen_from_two_sides_gives_the_scale() -> None:
    dataset = Wall(views(15, 0.6))
    told: list[tuple[int, int]] = []
    (found,) = from_markers(
        dataset,
        mapped(dataset, 0.25),
        MarkerSpec("DICT_4X4_50", 0.2),
        lambda done, total: told.append((done, total)),
    )
    assert found.factor == pytest.approx(4.0, rel=0.01)
    assert found.sigma_log is not None
    assert found.sigma_log < 0.02
    assert "marker DICT_4X4_50 3 of 0.2 m" in found.how
    assert told
    assert all(done < total for done, total in told)


def test_a_marker_seen_from_one_side_only_is_refused_in_one_line() -> None:
    dataset = Wall(views(10, 0.005))
    with pytest.raises(DatasetError, match=r"never from two sides \(0\.\d degrees apart at most\)") as raised:
        from_markers(dataset, mapped(dataset, 1.0), MarkerSpec("DICT_4X4_50", 0.2))
    assert "\n" not in str(raised.value)
    with pytest.raises(DatasetError, match="no tag36h11 marker was found in 10 images"):
        from_markers(dataset, mapped(dataset, 1.0), MarkerSpec("tag36h11", 0.2))


def test_markers_scale_a_run_and_the_report_names_each(tmp_path: Path) -> None:
    dataset = Wall(views(15, 0.6))
    before = PredictionScale(ScaleSource.NETWORK, "depth predicted by x", None)
    config = Config.from_dict({"scale": {"marker": ["DICT_4X4_50:0.2", "tag16h5:0.1"]}})
    stages: list[str] = []
    made, facts, notes = settle_scale(
        dataset, mapped(dataset, 0.25), before, config, lambda step: stages.append(step.stage.value)
    )
    assert facts.factor == pytest.approx(4.0, rel=0.01)
    assert facts.interval is not None
    assert [(part.source, part.weight) for part in facts.parts] == [
        (ScaleSource.NETWORK, 0),
        (ScaleSource.MARKER, 1),
    ]
    assert "of true metres, two in three" in facts.sentence
    assert notes == ("no scale from marker tag16h5:0.1: no tag16h5 marker was found in 15 images",)
    assert set(stages) == {"looking for markers"}
    np.testing.assert_allclose(made.trajectory.T_world_camera[:, :3, 3], dataset._poses[:, :3, 3], atol=0.02)
