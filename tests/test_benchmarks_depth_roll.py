# SPDX-License-Identifier: Apache-2.0
"""What a rolled camera costs: the roll of true poses, and an image turned and its prediction turned back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_up import MadeUpDataset

from benchmarks.depth_roll import judged, main, predicted_upright, true_down
from slamdepth.depth.upright import roll_rad
from slamdepth.geometry import se3_exp
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, Trajectory

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
UP = np.array([0.0, 0.0, 1.0])
# looking along the world's y: right is x, down is -z
T_WORLD_LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def rolled(angle_rad: float, tilt_rad: float = 0.0) -> np.ndarray:
    tilt = se3_exp(np.array([0, 0, 0, tilt_rad, 0, 0]))
    return T_WORLD_LEVEL @ tilt @ se3_exp(np.array([0, 0, 0, 0, 0, angle_rad]))


class Brightness:
    """Predicts how bright a pixel is, so that a prediction shows how the image was turned."""

    name, kind, weights = "brightness", DepthKind.METRIC, ()

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def predict(self, frame: Frame) -> DepthPrediction:
        self.seen.append(frame.image_rgb)
        values = 1.0 + frame.image_rgb[..., 0].astype(np.float32)
        return DepthPrediction(values, self.kind, np.full_like(values, 0.1))


def ramp_as_taken(angle_rad: float) -> np.ndarray:
    """A scene that gets brighter downwards, by a camera rolled by ``angle_rad``."""
    v, u = np.mgrid[:120, :160]
    down = np.array([np.sin(angle_rad), np.cos(angle_rad)])
    height = (u - CAMERA.cx) * down[0] + (v - CAMERA.cy) * down[1]
    return np.repeat(np.clip(128 + 0.8 * height, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("angle", [-1.0, 0.0, 0.4])
@pytest.mark.parametrize("tilt", [0.0, -0.5])
def test_the_roll_of_a_pose_is_that_of_down_in_the_image(angle: float, tilt: float) -> None:
    assert roll_rad(rolled(angle, tilt)[:3, :3].T @ -UP) == pytest.approx(angle, abs=1e-9)


@pytest.mark.parametrize("angle", [-0.6, 0.35])
def test_an_image_is_shown_upright_and_its_depth_comes_back_as_taken(angle: float) -> None:
    model = Brightness()
    frame = Frame(0, 0.0, ramp_as_taken(angle), CAMERA)
    plain = model.predict(frame)
    made = predicted_upright(model, frame, angle, plain)
    upright = model.seen[1][40:80, 50:110, 0].astype(float)
    assert np.ptp(upright, axis=1).max() <= 2  # rows are level now
    assert (np.diff(upright.mean(axis=1)) > 0.5).all()
    np.testing.assert_allclose(made.values, plain.values, atol=2.5)
    assert made.sigma_log is not None
    assert (made.sigma_log == np.float32(0.1)).all()


def test_gravity_of_a_frame_is_that_of_the_pose_nearest_in_time_if_one_is_near() -> None:
    truth = Trajectory(np.array([0.0, 1.0]), np.stack([rolled(0.3), rolled(-0.2)]))
    down = true_down(truth, UP)
    frame = Frame(0, 0.98, ramp_as_taken(0.0), CAMERA)
    found = down(frame)
    assert found is not None
    assert roll_rad(found) == pytest.approx(-0.2)
    assert down(replace(frame, timestamp_s=0.5)) is None


class FloorByRows(Brightness):
    """Takes the image's rows for those of an upright camera."""

    def predict(self, frame: Frame) -> DepthPrediction:
        self.seen.append(frame.image_rgb)
        rows = np.arange(120, dtype=np.float32)[:, None]
        return DepthPrediction(np.repeat(5.0 - 0.02 * rows, 160, axis=1), self.kind)


class RolledFloor(MadeUpDataset):
    """A floor, by a camera rolled by 0.4 rad; the third of its four frames has no pose near in time."""

    camera = CAMERA

    def __init__(self) -> None:
        super().__init__(4)
        self.ground_truth = Trajectory(self.timestamps_s[[0, 1, 3]], np.stack([rolled(0.4)] * 3))

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        image = ramp_as_taken(0.4)
        depth_m = 5.0 - 0.02 * (CAMERA.cy + (image[..., 0] - 128.0) / 0.8)
        return Frame(index, float(self.timestamps_s[index]), image, CAMERA, depth_m.astype(np.float32))


def test_each_image_is_predicted_once_as_taken_once_upright_and_once_told() -> None:
    model = FloorByRows()
    as_taken, upright, told, errors_deg = judged(RolledFloor(), model, UP, stride=1)
    assert len(model.seen) == 4 + 3 + 3
    assert len(told.per_frame["as_predicted.abs_rel"]) == len(errors_deg) == 3
    of_taken, of_upright = (np.array(j.per_frame["as_predicted.abs_rel"]) for j in (as_taken, upright))
    assert (of_taken > 0.08).all()
    assert (of_upright[[0, 1, 3]] < 0.03).all()  # what is left was cut off at the corners
    assert of_upright[2] == of_taken[2]


class Knowing(FloorByRows):
    """Believes that every image is upright, unless it is told."""

    def predict(self, frame: Frame) -> DepthPrediction:
        if frame.gravity is not None:
            as_taken = super().predict(frame)
            return predicted_upright(self, replace(frame, gravity=None), roll_rad(frame.gravity), as_taken)
        found = None if frame.index == 3 else np.array([0.0, 1.0, 0.0])
        return replace(super().predict(frame), gravity=found, gravity_share=1.0)


def test_a_model_is_told_which_way_is_down_and_asked() -> None:
    _, _, told, errors_deg = judged(RolledFloor(), Knowing(), UP, stride=1)
    assert (np.array(told.per_frame["as_predicted.abs_rel"]) < 0.03).all()
    np.testing.assert_allclose(errors_deg, [np.degrees(0.4)] * 2 + [180.0], atol=1e-6)


def test_a_sequence_without_poses_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rgb").mkdir()
    cv2.imwrite(str(tmp_path / "rgb" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "rgb.txt").write_text("0.0 rgb/0.png\n")
    (tmp_path / "camera.yaml").write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")
    code = main([str(tmp_path)])
    printed = capsys.readouterr().err
    assert code != 0
    assert printed.startswith("error:")
    assert printed.count("\n") == 1
