# SPDX-License-Identifier: Apache-2.0
"""The robustness benchmark: corrupted frames agree with their camera and their ground truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_up import MadeUpDataset, pose

from benchmarks.corruptions import CORRUPTIONS, mirrored_truth
from benchmarks.robustness import main
from slamdepth.geometry import se3_exp
from slamdepth.types import Camera, Trajectory

CAMERA = Camera(64, 48, 50.0, 52.0, 30.0, 22.0, (0.2, -0.3, 0.01, -0.02, 0.1))


def seen_px(camera: Camera, T_world_camera: np.ndarray, points_w: np.ndarray) -> np.ndarray:
    T = np.linalg.inv(T_world_camera)
    px, _ = cv2.projectPoints(
        points_w, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.distortion_array
    )
    return px[:, 0]


def test_a_mirrored_camera_sees_the_mirrored_world_as_its_image_shows_it() -> None:
    rng = np.random.default_rng(0)
    points_w = rng.uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    T = se3_exp(np.array([0.1, -0.2, 0.3, 0.05, 0.1, -0.2]))
    mirrored = mirrored_truth(Trajectory(np.zeros(1), T[None])).T_world_camera[0]
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1.0)
    px = seen_px(CAMERA, T, points_w)
    other = seen_px(CAMERA.mirrored(), mirrored, points_w * [-1, 1, 1])
    np.testing.assert_allclose(other, np.stack([CAMERA.width - 1 - px[:, 0], px[:, 1]], axis=1), atol=1e-9)


def made_up(count: int = 100) -> MadeUpDataset:
    dataset = MadeUpDataset(count)
    dataset.ground_truth = Trajectory(dataset.timestamps_s, np.stack([pose(0.1 * n) for n in range(count)]))
    return dataset


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_frames_are_of_their_camera_and_time_goes_on(name: str) -> None:
    dataset, corruption = made_up(), CORRUPTIONS[name]
    camera = corruption.camera(dataset.camera)
    frames = list(corruption.play(dataset, 100, with_depth=True))
    truth = corruption.truth_of(dataset, 100)
    assert (np.diff([f.timestamp_s for f in frames]) > 0).all()
    assert (np.diff(truth.timestamps_s) > 0).all()
    for frame in frames:
        assert frame.camera == camera
        assert frame.image_rgb.shape == (camera.height, camera.width, 3)
        assert frame.image_rgb.flags.c_contiguous
        if frame.depth_m is not None:
            assert frame.depth_m.shape == (camera.height, camera.width)
    at = np.searchsorted(truth.timestamps_s, frames[0].timestamp_s)
    first = {"backwards": 99, "begun at frame 50": 50}.get(name, 0)
    assert abs(truth.T_world_camera[at][0, 3]) == pytest.approx(0.1 * first)


def test_what_is_taken_away() -> None:
    dataset = made_up()
    dropped = list(CORRUPTIONS["gaps of 8 frames"].play(dataset, 100, with_depth=False))
    assert [f.index for f in dropped] == [*range(82), *range(90, 100)]
    third = list(CORRUPTIONS["every third frame"].play(dataset, 10, with_depth=False))
    assert [f.index for f in third] == [0, 3, 6, 9]
    later = list(CORRUPTIONS["begun at frame 50"].play(dataset, 53, with_depth=False))
    assert [f.index for f in later] == [50, 51, 52]
    black = list(CORRUPTIONS["two seconds black"].play(dataset, 100, with_depth=False))
    assert [f.index for f in black[1:] if not f.image_rgb.any()] == list(range(33, 93))
    sparse = list(CORRUPTIONS["depth of 4 in 7 frames"].play(dataset, 14, with_depth=True))
    assert sum(f.depth_m is not None for f in sparse) == 8


def test_laps_follow_one_another_at_the_pace_of_the_sequence() -> None:
    dataset, laps = made_up(), CORRUPTIONS["three times over"]
    frames, truth = list(laps.play(dataset, 40, with_depth=False)), laps.truth_of(dataset, 40)
    assert [f.index for f in frames] == list(range(120))
    step_s = dataset.timestamps_s[1] - dataset.timestamps_s[0]
    np.testing.assert_allclose(np.diff([f.timestamp_s for f in frames]), step_s)
    np.testing.assert_allclose(truth.timestamps_s, [f.timestamp_s for f in frames])
    np.testing.assert_array_equal(frames[85].image_rgb, frames[5].image_rgb)
    np.testing.assert_array_equal(truth.T_world_camera[85], truth.T_world_camera[5])


def test_a_short_run(tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = tmp_path / "robustness.json"
    wanted = ["--depth", "sensor", "--corruptions", "mirrored,backwards", "--max-frames", "30"]
    assert main([str(tiny_room), *wanted, "--output", str(found)]) == 0
    rows = json.loads(found.read_text(encoding="utf-8"))["rows"]
    assert [row["corruption"] for row in rows] == ["mirrored", "backwards"]
    for row in rows:
        assert row["tracked"] == 1.0
        assert row["ate_se3_m"] < 0.02
    assert "| mirrored | 100.0 |" in capsys.readouterr().out
    assert str(tmp_path) not in found.read_text(encoding="utf-8")


def test_bad_input_is_one_line(tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tiny_room), "--corruptions", "none"]) != 0
    assert "no corruption 'none'; there are: as it is, mirrored" in capsys.readouterr().err
    assert main([str(tmp_path / "nowhere")]) != 0
    assert capsys.readouterr().err.startswith("error: ")
