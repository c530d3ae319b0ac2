# SPDX-License-Identifier: Apache-2.0
"""The tracker on the beginnings of real sequences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tracking_scene import ConstantDepth

from slamdepth.config import Config
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.sensor import SensorDepth
from slamdepth.evaluation import score_trajectory
from slamdepth.geometry import invert
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking import Tracker
from slamdepth.types import Frame, StepResult, TrackingStatus, Trajectory

pytestmark = pytest.mark.data


def opened(folder: Path) -> tuple[Dataset, Trajectory]:
    """A sequence and its ground truth; skips the test where the sequence is absent."""
    if not folder.is_dir():
        pytest.skip(f"{folder.name} is absent")
    dataset = open_dataset(folder)
    assert dataset.ground_truth is not None
    return dataset, dataset.ground_truth


def run_beginning(folder: Path, count: int, model: DepthModel) -> tuple[Reconstruction, Trajectory]:
    """The first ``count`` frames, none of them lost; with the ground truth."""
    dataset, truth = opened(folder)
    tracker = Tracker(dataset.camera, model, Config())
    for index in range(count):
        result = tracker.step(dataset.read(index, with_depth=model.name == "sensor"))
        assert result.status is TrackingStatus.TRACKING, f"frame {index}: {result.status.value}"
    made = tracker.finish()
    assert made.statistics.tracked == made.statistics.frames == count
    assert np.isfinite(made.trajectory.T_world_camera).all()
    return made, truth


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


def errors_in_one_map_m(
    results: list[StepResult], taken_s: list[float], truth: Trajectory, aligned: int
) -> np.ndarray:
    """``(N,)`` distances from the truth, NaN where lost; the first ``aligned`` frames alone are aligned.

    Args:
        taken_s: when each frame was taken, whatever its time in the run.
    """
    found = [None if r.T_world_camera is None else r.T_world_camera[:3, 3] for r in results]
    estimate = np.array([np.full(3, np.nan) if p is None else p for p in found])
    nearest = [int(np.argmin(np.abs(truth.timestamps_s - t))) for t in taken_s]
    moved = invert(truth.T_world_camera[nearest[0]]) @ truth.T_world_camera[nearest]
    first = results[0].T_world_camera
    assert first is not None
    moved = first @ moved
    shift = np.nanmean(estimate[:aligned] - moved[:aligned, :3, 3], axis=0)
    distance_m: np.ndarray = np.linalg.norm(estimate - moved[:, :3, 3] - shift, axis=1)
    return distance_m


def test_two_seconds_of_black_frames_in_the_kitchen(data_dir: Path) -> None:
    """Frames 200 to 259 show nothing and measure nothing; what follows is in the map of before.

    Two thirds of what frame 260 sees was seen by then; with less than a half it stays lost.
    """
    dataset, truth = opened(data_dir / "7scenes_redkitchen_seq-01")
    tracker = Tracker(dataset.camera, SensorDepth(), Config())
    results, taken_s = [], []
    for index in range(160, 300):
        frame: Frame = dataset.read(index, with_depth=True)
        if 200 <= index < 260:
            frame = replace(frame, image_rgb=np.zeros_like(frame.image_rgb), depth_m=None)
        results.append(tracker.step(frame))
        taken_s.append(frame.timestamp_s)
    assert all(r.status is TrackingStatus.TRACKING for r in results[:40])
    assert all(r.status is TrackingStatus.LOST for r in results[40:100])
    found = next((k for k in range(100, 130) if results[k].T_world_camera is not None), None)
    assert found is not None, "not relocalised within a second"
    assert results[found].status is TrackingStatus.RELOCALISED
    assert all(r.T_world_camera is not None for r in results[found:])
    errors = errors_in_one_map_m(results, taken_s, truth, aligned=40)
    # alignment by the first pose alone: a milliradian there is millimetres here; the camera moves by 0.9 m
    assert errors[found:].max() < 0.15
    made = tracker.finish()
    assert made.statistics.relocalisations == 1
    assert score_trajectory(truth, made.trajectory).se3.rmse_m < 0.06


def test_fr1_rpy_from_the_middle_and_then_from_the_start(data_dir: Path) -> None:
    """Frames 300 to 379, then 0 to 49: a jump by more than a frame's motion, into a place seen before."""
    dataset, truth = opened(data_dir / "rgbd_dataset_freiburg1_rpy")
    tracker = Tracker(dataset.camera, SensorDepth(), Config())
    results, taken_s = [], []
    for k, index in enumerate([*range(300, 380), *range(50)]):
        frame = dataset.read(index, with_depth=True)
        taken_s.append(frame.timestamp_s)
        results.append(tracker.step(replace(frame, timestamp_s=k / 30.0)))
    assert all(r.T_world_camera is not None for r in results[:80])
    assert TrackingStatus.RELOCALISED in {r.status for r in results[80:]}
    assert all(r.T_world_camera is not None for r in results[-30:])
    errors = errors_in_one_map_m(results, taken_s, truth, aligned=80)
    assert np.nanmax(errors[80:]) < 0.1
