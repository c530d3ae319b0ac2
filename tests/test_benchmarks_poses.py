# SPDX-License-Identifier: Apache-2.0
"""Covariances of poses, judged on made-up motions whose errors are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import poses as benchmark
from benchmarks.poses_scores import (
    EXACT,
    Poses,
    TruthError,
    figures,
    interpolated,
    is_bad,
    local_scales,
    motions,
    pairs,
)
from slamdepth.geometry import se3_exp, so3_exp
from slamdepth.types import StepResult, TrackingStatus, Trajectory

COUNT = 240
TIMES_S = np.arange(COUNT) / 30.0
SIGMA = np.repeat([0.004, 0.002], 3)  # metres and radians


def path() -> np.ndarray:
    """A camera on a circle that turns about all axes, ``(COUNT, 4, 4)``."""
    t = TIMES_S[:, None]
    turn = np.hstack([0.3 * np.sin(t), 0.5 * t, 0.2 * np.cos(0.7 * t)])
    return se3_exp(np.hstack([2 * np.cos(0.4 * t), 0.3 * np.sin(t), 2 * np.sin(0.4 * t), turn]))


def made_up(scale: float = 1.0, sigma: float = 1.0, seed: int = 0) -> Poses:
    """Poses off by ``SIGMA`` that say ``sigma`` times as much, in a unit of ``scale`` metres."""
    truth, estimate = path(), path()
    errors = SIGMA * np.random.default_rng(seed).normal(size=(COUNT, 6))
    estimate[:, :3, 3] = (estimate[:, :3, 3] + errors[:, :3]) / scale
    estimate[:, :3, :3] = so3_exp(errors[:, 3:]) @ estimate[:, :3, :3]
    said = np.diag((sigma * SIGMA / np.repeat([scale, 1.0], 3)) ** 2)
    return Poses(TIMES_S, estimate, truth, np.tile(said, (COUNT, 1, 1)), np.full(COUNT, 0.9))


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize("span_s", [0.0, 1 / 3, 1.0])
def test_a_right_covariance_gives_a_normalised_error_of_one(scale: float, span_s: float) -> None:
    poses = made_up(scale)
    squared = motions(poses, span_s, local_scales(poses)).squared()
    assert len(squared) > 200
    assert squared.mean() / 6.0 == pytest.approx(1.0, abs=0.15)


def test_half_the_deviation_gives_four_times_the_error() -> None:
    poses = made_up(sigma=0.5)
    assert motions(poses, 1.0, np.ones(COUNT)).squared().mean() / 6.0 == pytest.approx(4.0, abs=0.5)


def test_errors_of_the_truth_are_allowed_for() -> None:
    poses, none = made_up(sigma=1e-3), TruthError(0.0, SIGMA[0], SIGMA[3])
    assert motions(poses, 1.0, np.ones(COUNT), none).squared().mean() / 6.0 == pytest.approx(1.0, abs=0.15)
    late = made_up(sigma=1.0)
    late = Poses(late.times_s, np.roll(path(), 1, axis=0), path(), late.covariance, late.quality)
    exact = motions(late, 0.0, np.ones(COUNT)).squared()[5:]
    clock = motions(late, 0.0, np.ones(COUNT), TruthError(1 / 30)).squared()[5:]
    assert clock.max() < exact.max()


def test_scales_are_those_of_the_estimate() -> None:
    np.testing.assert_allclose(local_scales(made_up(2.5)), 2.5, rtol=0.01)


def test_a_pose_that_jumps_there_and_back_is_the_only_bad_one() -> None:
    poses = made_up()
    poses.estimate[100, :3, 3] += [0.0, 0.2, 0.0]
    bad = is_bad(poses, 2.0, np.ones(COUNT))
    assert np.flatnonzero(bad).tolist() == [100]


def test_a_correction_of_the_map_makes_no_pose_bad() -> None:
    poses = made_up()
    poses.estimate[100:, :3, 3] += [0.0, 0.2, 0.0]
    assert not is_bad(poses, 2.0, np.ones(COUNT)).any()


def test_poses_called_good_are_counted_with_those_that_are_bad() -> None:
    poses = made_up()
    poses.estimate[[100, 150], :3, 3] += [0.0, 0.2, 0.0]
    poses.quality[[100, 20]] = 0.1
    found = figures(poses, 2.0)
    assert {key: found[key] for key in ("poses", "good", "good_bad", "poor", "poor_bad")} == {
        "poses": COUNT, "good": COUNT - 2, "good_bad": 1, "poor": 2, "poor_bad": 1,
    }  # fmt: skip


def test_pairs_skip_gaps() -> None:
    times_s = np.array([0.0, 0.1, 0.2, 0.7, 0.8])
    np.testing.assert_array_equal(pairs(times_s, 0.0), [[0, 1, 3], [1, 2, 4]])
    np.testing.assert_array_equal(pairs(times_s, 0.5), [[1, 2], [3, 3]])


def test_true_poses_are_interpolated_but_not_over_gaps() -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.0, 5.0]
    truth = Trajectory(np.array([0.0, 0.1, 0.9]), T)
    found, known = interpolated(truth, np.array([0.05, 0.1, 0.5, 0.9, 1.2]))
    assert known.tolist() == [True, True, False, True, False]
    np.testing.assert_allclose(found[known, 0, 3], [0.5, 1.0, 5.0])


def test_frames_without_a_covariance_take_part_in_the_count_only() -> None:
    steps = [
        StepResult(n, float(t), TrackingStatus.TRACKING, T, covariance=None if n % 2 else np.diag(SIGMA**2))
        for n, (t, T) in enumerate(zip(TIMES_S, path(), strict=True))
    ]
    steps[7] = StepResult(7, float(TIMES_S[7]), TrackingStatus.LOST, None)
    poses = Poses.of(steps, Trajectory(TIMES_S, path()))
    assert len(poses) == COUNT - 1
    assert len(motions(poses, 0.0, np.ones(len(poses))).squared()) == 0
    assert figures(poses, 2.0, EXACT)["poor"] == COUNT - 1


def test_nothing_to_run_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main([]) == 2
    assert capsys.readouterr().err == "error: nothing to run: name --data or --also\n"


def test_a_rendered_room_is_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from slamdepth.synth.sequence import SynthSettings, render_sequence

    settings = SynthSettings.from_dict({"frames": 40, "width": 320, "height": 240, "seed": 3})
    render_sequence(tmp_path / "room", settings)
    arguments: list[Any] = ["--also", str(tmp_path / "room"), "--depth", "sensor"]
    assert benchmark.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "| room | sensor | 1 frame | 39 |" in printed
    assert "| room | sensor | 40 | 40 | 0 (0.0 %) | 0 | - |" in printed
