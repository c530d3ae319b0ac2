# SPDX-License-Identifier: Apache-2.0
"""The tracker on the beginnings of real sequences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tracking_scene import ConstantDepth

from slamdepth.config import Config
from slamdepth.datasets import open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.sensor import SensorDepth
from slamdepth.evaluation import score_trajectory
from slamdepth.tracker import Tracker
from slamdepth.types import Reconstruction, TrackingStatus, Trajectory

pytestmark = pytest.mark.data


def run_beginning(folder: Path, count: int, model: DepthModel) -> tuple[Reconstruction, Trajectory]:
    """The first ``count`` frames, none of them lost; with the ground truth."""
    if not folder.is_dir():
        pytest.skip(f"{folder.name} is absent")
    dataset = open_dataset(folder)
    assert dataset.ground_truth is not None
    tracker = Tracker(dataset.camera, model, Config())
    for index in range(count):
        result = tracker.step(dataset.read(index, with_depth=model.name == "sensor"))
        assert result.status is TrackingStatus.TRACKING, f"frame {index}: {result.status.value}"
    made = tracker.finish()
    assert made.tracked == made.frames == count
    assert np.isfinite(made.trajectory.T_world_camera).all()
    return made, dataset.ground_truth


def test_fr1_rpy_with_a_sensor(data_dir: Path) -> None:
    """Hardly anything but rotation, at up to 50 degrees a second."""
    made, truth = run_beginning(data_dir / "rgbd_dataset_freiburg1_rpy", 150, SensorDepth())
    assert score_trajectory(truth, made.trajectory).se3.rmse_m < 0.03


def test_kitchen_with_a_sensor(data_dir: Path) -> None:
    made, truth = run_beginning(data_dir / "7scenes_redkitchen_seq-01", 100, SensorDepth())
    assert score_trajectory(truth, made.trajectory).se3.rmse_m < 0.03


def test_fr1_desk_with_a_prior_that_knows_nothing(data_dir: Path) -> None:
    """Two metres everywhere is enough: the views themselves tell the depth."""
    made, truth = run_beginning(data_dir / "rgbd_dataset_freiburg1_desk", 120, ConstantDepth(sigma_log=0.45))
    assert score_trajectory(truth, made.trajectory).sim3.rmse_m < 0.03
