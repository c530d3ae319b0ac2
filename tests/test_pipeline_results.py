# SPDX-License-Identifier: Apache-2.0
"""Mesh and scores of a finished reconstruction."""

from __future__ import annotations

import numpy as np
import pytest
from made_up import MadeUpDataset, pose

from slamdepth.depth.alignment import as_given
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.results import judge_trajectory, keyframe_trajectory, score_depth
from slamdepth.types import DepthKind, DepthPrediction, Trajectory


def keyframe(number: int, scale: float, *, is_sensor: bool = False) -> Keyframe:
    dataset = MadeUpDataset(number + 1)
    depth = np.full((6, 8), (1.0 + number) * scale, np.float32)
    return Keyframe(
        number,
        StoredFrame(dataset.read(number)),
        pose(number),
        np.zeros((0, 2)),
        1.0,
        StoredPrediction(DepthPrediction(depth, DepthKind.METRIC, is_sensor=is_sensor)),
        as_given,
    )


def test_predicted_depth_is_judged_as_the_model_gave_it() -> None:
    score, notes = score_depth(MadeUpDataset(5), tuple(keyframe(i, 1.25) for i in (0, 2, 4)))
    assert notes == ()
    assert score is not None
    assert score.frames == 3
    assert score.metric.abs_rel == pytest.approx(0.25, abs=1e-6)
    assert score.sequence_median.abs_rel == pytest.approx(0.0, abs=1e-6)
    assert score.sequence_scale == pytest.approx(0.8, abs=1e-6)


def test_a_sensor_is_not_judged_against_itself() -> None:
    assert score_depth(MadeUpDataset(1), (keyframe(0, 1.0, is_sensor=True),)) == (None, ())


def test_keyframes_whose_depth_is_broken_are_left_out() -> None:
    score, _ = score_depth(MadeUpDataset(2, broken_depth=(0,)), (keyframe(0, 2.0), keyframe(1, 1.0)))
    assert score is not None
    assert (score.frames, score.metric.abs_rel) == (1, 0.0)


def test_a_trajectory_that_cannot_be_scored_is_a_note() -> None:
    dataset = MadeUpDataset(5)
    still = Trajectory(dataset.timestamps_s, np.tile(np.eye(4), (5, 1, 1)))
    assert judge_trajectory(dataset, still) == (None, ())
    dataset.ground_truth = still
    score, notes = judge_trajectory(dataset, still)
    assert score is None
    assert "not scored" in notes[0]


@pytest.mark.parametrize(
    ("factor", "is_noted"), [(1.0, False), (1.2, False), (0.82, False), (1.3, True), (0.5, True)]
)
def test_a_sensor_whose_scale_is_not_the_truths_is_a_note(
    factor: float, is_noted: bool, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = MadeUpDataset(30)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(30, 3))
    estimate = Trajectory(dataset.timestamps_s, poses)
    truth = poses.copy()
    truth[:, :3, 3] *= factor
    dataset.ground_truth = Trajectory(dataset.timestamps_s, truth)
    assert judge_trajectory(dataset, estimate)[1] == ()  # a network's map may have any scale
    score, notes = judge_trajectory(dataset, estimate, is_measured=True)
    assert score is not None
    assert score.sim3.scale == pytest.approx(factor)
    assert len(notes) == is_noted
    assert all("check depth_factor and the intrinsics" in text for text in (*notes, *caplog.messages))
    assert len(caplog.messages) == is_noted


def test_keyframes_become_a_trajectory() -> None:
    frames = (keyframe(0, 1.0), keyframe(3, 1.0))
    trajectory = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), is_metric=False)
    found = keyframe_trajectory(Reconstruction(trajectory, frames, np.zeros((0, 3))))
    assert found.timestamps_s.tolist() == [0.0, 0.3]
    assert found.T_world_camera[:, 0, 3].tolist() == [0.0, 3.0]
    assert not found.is_metric
    empty = keyframe_trajectory(Reconstruction(trajectory, (), np.zeros((0, 3))))
    assert len(empty) == 0
