# SPDX-License-Identifier: Apache-2.0
"""Which poses of a trajectory no motion confirms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamdepth.evaluation.leaps import confirmed, find_leaps, repeated_poses, unconfirmed_poses
from slamdepth.geometry import se3_exp
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

FPS = 30.0
COUNT = 200
SCENE_M = 2.0


def walk(count: int = COUNT) -> Floats:
    """Poses ``(count, 4, 4)`` of a camera that goes sideways and turns."""
    n = np.arange(count)
    zero = np.zeros(count)
    return se3_exp(np.stack([0.005 * n, zero, zero, zero, 0.004 * n, zero], axis=1))


def at(poses: Floats, kept: np.ndarray | None = None, fps: float = FPS) -> Trajectory:
    """The trajectory of ``poses``, or of those ``kept``, which leaves gaps."""
    kept = np.arange(len(poses)) if kept is None else kept
    return Trajectory(kept / fps, poses[kept])


def moved(first: int, end: int, by_m: float = 0.5) -> Floats:
    """The walk with the poses from ``first`` to ``end``, exclusive, elsewhere."""
    poses = walk()
    poses[first:end, 1, 3] += by_m
    return poses


def unconfirmed(trajectory: Trajectory) -> list[int]:
    return [int(n) for n in np.flatnonzero(unconfirmed_poses(trajectory, SCENE_M))]


def test_a_steady_path_is_confirmed() -> None:
    assert unconfirmed(at(walk())) == []


@pytest.mark.parametrize("end", [101, 102, 110, 125])
def test_a_piece_of_less_than_a_second_between_two_leaps_is_not(end: int) -> None:
    trajectory = at(moved(100, end))
    assert unconfirmed(trajectory) == list(range(100, end))


@pytest.mark.parametrize("times", [12.0, 20.0])
def test_the_step_after_a_repeated_image_is_no_leap(times: float) -> None:
    """A quick turn while an image is repeated: the next step has the motion of both."""
    steps = np.full(COUNT, 0.004)
    steps[100:103] = 0.0, times * 0.004, 0.5 * times * 0.004
    turned = np.zeros((COUNT, 6))
    turned[:, 4] = np.cumsum(steps)
    assert find_leaps(at(se3_exp(turned)), SCENE_M).tolist() == []


def test_a_leap_after_a_repeated_image_is_found() -> None:
    poses = moved(100, COUNT)
    poses[99] = poses[98]
    assert find_leaps(at(poses), SCENE_M).tolist() == [99]


def test_of_poses_that_all_repeat_one_another_every_second_one_counts() -> None:
    speed = np.ones(41)
    speed[10:21] = 0.0
    found = repeated_poses(speed, np.full(41, 1.0 / FPS))
    assert np.flatnonzero(found).tolist() == [11, 13, 15, 17, 19, 21]


def test_two_long_pieces_with_a_leap_between_them_are_kept() -> None:
    """As where a recording was cut, or where a loop was closed."""
    trajectory = at(moved(100, COUNT))
    assert find_leaps(trajectory, SCENE_M).tolist() == [99]
    assert unconfirmed(trajectory) == []


def test_a_confirmed_trajectory_is_handed_back_as_it_is() -> None:
    points_w = SCENE_M * np.random.default_rng(1).normal(size=(500, 3))
    steady, leaping = at(walk()), at(moved(100, 110))
    assert confirmed(steady, points_w) is steady
    kept = np.r_[0:100, 110:COUNT]
    np.testing.assert_array_equal(confirmed(leaping, points_w).timestamps_s, kept / FPS)
    np.testing.assert_array_equal(confirmed(leaping, points_w).T_world_camera, walk()[kept])


def test_a_piece_of_over_a_second_between_two_leaps_is_kept() -> None:
    assert unconfirmed(at(moved(100, 132))) == []


@pytest.mark.parametrize(("first", "end"), [(0, 12), (190, COUNT)])
def test_a_short_piece_at_an_end_that_only_a_leap_joins_is_not(first: int, end: int) -> None:
    assert unconfirmed(at(moved(first, end))) == list(range(first, end))


def test_a_short_piece_between_a_leap_and_a_gap_is_not() -> None:
    kept = np.r_[0:110, 125:COUNT]
    assert unconfirmed(at(moved(100, 110), kept)) == list(range(100, 110))


def test_a_good_short_piece_after_a_leap_is_kept_only_where_no_motion_led_there() -> None:
    """After a cut in the recording nothing leads to the first pose; a tracker that slips was led there."""
    trajectory, good = at(moved(190, COUNT)), np.ones(COUNT)
    led = np.ones(COUNT, dtype=bool)
    assert np.flatnonzero(unconfirmed_poses(trajectory, SCENE_M, good, led)).tolist() == list(
        range(190, COUNT)
    )
    led[190] = False
    assert not unconfirmed_poses(trajectory, SCENE_M, good, led).any()


def test_a_short_piece_between_two_gaps_is_kept_without_a_leap() -> None:
    kept = np.r_[0:60, 80:90, 110:COUNT]
    assert unconfirmed(at(walk(), kept)) == []


def test_one_or_two_poses_alone_are_not_confirmed_by_any_motion() -> None:
    kept = np.r_[0, 30:80, 100:102, 120:COUNT]
    assert unconfirmed(at(walk(), kept)) == [0, 51, 52]
    three = np.r_[0:3, 30:COUNT]
    assert unconfirmed(at(walk(), three)) == []


def test_at_few_frames_a_second_a_single_lost_frame_is_no_gap() -> None:
    kept = np.r_[0, 2:10, 11, 13:30]
    assert unconfirmed(at(walk(), kept, fps=5.0)) == []


def test_a_quick_turn_over_several_frames_is_kept() -> None:
    poses = walk()
    turn = np.zeros((COUNT, 6))
    turn[100:, 4] = np.minimum(0.25 * np.arange(100), 1.0)
    poses = poses @ se3_exp(turn)
    assert unconfirmed(at(poses)) == []


def test_at_few_frames_a_second_nothing_is_judged() -> None:
    assert unconfirmed(at(moved(100, 101), fps=3.0)) == []


def test_the_longest_piece_is_kept_however_short() -> None:
    poses = walk(10)
    poses[6:, 1, 3] += 0.5
    assert unconfirmed(at(poses)) == [6, 7, 8, 9]


def test_a_star_of_spikes_leaves_none() -> None:
    """Every tenth pose is elsewhere; the rest are a smooth path."""
    poses = walk()
    wrong = np.arange(5, COUNT, 10)
    poses[wrong, :3, 3] += np.random.default_rng(0).normal(size=(len(wrong), 3))
    found = unconfirmed_poses(at(poses), SCENE_M)
    assert found[wrong].all()
    rest = Trajectory(at(poses).timestamps_s[~found], poses[~found])
    assert len(find_leaps(rest, SCENE_M)) == 0


def test_without_a_distance_rotations_count() -> None:
    poses = walk()
    poses[50] = poses[50] @ se3_exp(np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0]))
    assert np.flatnonzero(unconfirmed_poses(at(poses), None)).tolist() == [50]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_trajectory_of_few_poses_is_kept(count: int) -> None:
    assert unconfirmed(at(walk(count))) == []


@given(st.lists(st.integers(0, 59), max_size=12), st.integers(0, 1000))
def test_what_is_left_needs_no_second_pass(wrong: list[int], seed: int) -> None:
    poses = walk(60)
    poses[wrong, :3, 3] += np.random.default_rng(seed).normal(size=(len(wrong), 3))
    found = unconfirmed_poses(at(poses), SCENE_M)
    assert not found.all()
    rest = at(poses, np.flatnonzero(~found))
    assert unconfirmed(rest) == []
