# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run in several maps, on each of them, and on stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_up_runs import COUNT, FPS, facts, kinds, moved_from, states, walk, wall

from slamdepth.evaluation import MapFacts, RunFacts, SpanKind, Verdict, judge_run
from slamdepth.types import RunStatistics, TrackingStatus, Trajectory


def with_other_map(first: int, end: int, count: int = COUNT, *, leap_at: int | None = None) -> RunFacts:
    """A run whose frames ``first`` to ``end`` are in a second map, in a frame of its own."""
    whole = facts(walk(count))
    path = whole.trajectory
    inside = np.zeros(count, dtype=bool)
    inside[first:end] = True
    poses = path.T_world_camera[inside].copy()
    poses[:, :3, 3] += 50.0
    if leap_at is not None:
        poses[leap_at:, 1, 3] += 1.0
    second = Trajectory(path.timestamps_s[inside], poses)
    return replace(
        whole,
        trajectory=Trajectory(path.timestamps_s[~inside], path.T_world_camera[~inside]),
        statistics=RunStatistics(frames=count, tracked=int((~inside).sum())),
        others=(MapFacts(second, wall() + 50.0, RunStatistics(tracked=int(inside.sum()))),),
    )


@pytest.mark.parametrize(
    ("frames", "verdict"), [(9, Verdict.GOOD), (45, Verdict.DOUBTFUL), (90, Verdict.NOT_TRUSTWORTHY)]
)
def test_frames_in_a_map_that_never_met_the_largest_count_as_lost_ones_do(
    frames: int, verdict: Verdict
) -> None:
    health = judge_run(with_other_map(COUNT - frames, COUNT))
    assert health.verdict is verdict
    assert kinds(health) == [SpanKind.OTHER_MAP]
    assert f"{round(100 * frames / COUNT)} % of the frames are in another map" in health.reasons[0]
    assert (health.numbers.maps, health.numbers.lost_share) == (2, 0.0)
    largest, other = health.maps
    assert largest.verdict is Verdict.GOOD
    assert largest.reasons == ()  # its own time has no frame of the other
    assert other.verdict is Verdict.DOUBTFUL
    assert "too short to judge" in other.headline
    if verdict is Verdict.GOOD:
        assert "97 % of the frames are in the largest of 2 maps" in health.headline


def test_a_leap_in_another_map_is_a_doubt_on_that_map_only() -> None:
    health = judge_run(with_other_map(COUNT - 12, COUNT, leap_at=6))
    assert health.verdict is Verdict.GOOD
    assert [one.numbers.leaps for one in health.maps] == [0, 1]
    assert health.maps[1].verdict is Verdict.DOUBTFUL
    leap = next(span for span in health.maps[1].spans if span.kind is SpanKind.LEAP)
    assert leap.to_s == pytest.approx((COUNT - 6) / FPS, abs=1e-3)  # counted from the run's first frame


def test_a_map_that_is_left_and_found_again_has_a_hole_there() -> None:
    health = judge_run(with_other_map(100, 200))
    assert kinds(health.maps[0]) == [SpanKind.OTHER_MAP]
    assert kinds(health.maps[1]) == []
    assert health.maps[0].good_spans_s == ()
    good = judge_run(with_other_map(450, 600, 1200)).maps[0].good_spans_s
    np.testing.assert_allclose(good, [(0.0, 450 / FPS), (600 / FPS, 1199 / FPS)], atol=1e-3)


def test_lost_frames_and_frames_elsewhere_are_added_up() -> None:
    some = with_other_map(COUNT - 40, COUNT)
    steps = [
        replace(step, status=TrackingStatus.LOST, T_world_camera=None) if 100 <= step.index < 125 else step
        for step in some.steps
    ]
    kept = ~np.isin(some.trajectory.timestamps_s, [step.timestamp_s for step in steps[100:125]])
    path = Trajectory(some.trajectory.timestamps_s[kept], some.trajectory.T_world_camera[kept])
    health = judge_run(replace(some, steps=steps, trajectory=path))
    assert health.numbers.missing_share == pytest.approx(65 / COUNT)
    assert health.verdict is Verdict.NOT_TRUSTWORTHY


@pytest.mark.parametrize(
    ("frames", "verdict"), [(3, Verdict.GOOD), (30, Verdict.DOUBTFUL), (90, Verdict.NOT_TRUSTWORTHY)]
)
def test_withdrawn_poses_are_stated_and_many_are_a_doubt(frames: int, verdict: Verdict) -> None:
    whole = facts()
    kept = np.r_[0:100, 100 + frames : COUNT]
    path = Trajectory(whole.trajectory.timestamps_s[kept], whole.trajectory.T_world_camera[kept])
    health = judge_run(replace(whole, trajectory=path))
    assert health.verdict is verdict
    assert kinds(health) == [SpanKind.WITHDRAWN]
    assert health.numbers.withdrawn_share == pytest.approx(frames / COUNT)
    assert "did not confirm" in health.reasons[0]


def test_a_frame_that_was_placed_after_all_is_not_lost() -> None:
    whole = facts()
    late = [replace(step, status=TrackingStatus.LOST, T_world_camera=None) for step in whole.steps[100:120]]
    health = judge_run(replace(whole, steps=[*whole.steps[:100], *late, *whole.steps[120:]]))
    assert health.numbers.lost_share == 0.0
    assert health.spans == ()


def test_a_map_of_five_seconds_is_judged_by_itself() -> None:
    health = judge_run(with_other_map(COUNT, 2 * COUNT, 2 * COUNT))
    assert [one.verdict for one in health.maps] == [Verdict.GOOD, Verdict.GOOD]
    assert [len(one.good_spans_s) for one in health.maps] == [1, 1]


def test_weak_frames_before_a_loss_are_not_bridged() -> None:
    lost = states(COUNT, (200, 210, TrackingStatus.LOST))
    held = [200] * 190 + [25] * 10 + [0] * 10 + [200] * 90
    health = judge_run(facts(states=lost, inliers=held))
    assert kinds(health) == [SpanKind.WEAK, SpanKind.LOST]
    assert health.verdict is Verdict.GOOD  # ten frames are stated
    assert "next to a loss" in health.reasons[0]
    longer = [200] * 180 + [25] * 20 + [0] * 10 + [200] * 90
    assert judge_run(facts(states=lost, inliers=longer)).verdict is Verdict.DOUBTFUL


def test_few_points_and_depth_alone_by_turns_are_one_stretch() -> None:
    mixed = states(COUNT, *((n, n + 5, TrackingStatus.REGISTERED) for n in range(100, 140, 10)))
    held = [200] * 100 + [20] * 40 + [200] * 160
    health = judge_run(facts(states=mixed, inliers=held))
    assert kinds(health) == [SpanKind.WEAK]
    assert health.spans[0].duration_s == pytest.approx(40 / FPS, abs=1e-3)
    assert health.verdict is Verdict.DOUBTFUL


def test_stretches_without_any_evidence_are_called_good() -> None:
    np.testing.assert_allclose(judge_run(facts()).maps[0].good_spans_s, [(0.0, 299 / FPS)], atol=1e-3)
    leap = judge_run(facts(moved_from(walk(600), 170, 1.0)))
    wanted = [(0.0, 169 / FPS), (170 / FPS, 599 / FPS)]
    np.testing.assert_allclose(leap.maps[0].good_spans_s, wanted, atol=1e-3)
    assert judge_run(facts(walk(140))).maps[0].good_spans_s == ()


def test_a_doubt_about_the_whole_map_leaves_no_stretch_called_good() -> None:
    assert judge_run(facts(keyframe_every=1)).maps[0].good_spans_s == ()


def test_lost_frames_after_a_map_are_no_doubt_on_the_map() -> None:
    health = judge_run(facts(states=states(COUNT, (200, COUNT, TrackingStatus.LOST))))
    assert health.verdict is Verdict.NOT_TRUSTWORTHY
    assert health.maps[0].verdict is Verdict.GOOD
    assert "every frame was tracked (200 of 200)" in health.maps[0].headline
