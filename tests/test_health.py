# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: each rule, and the innocent recording that looks like its case."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_up_runs import COUNT, FPS, SCENE_M, facts, kinds, moved_from, states, walk, wall

from slamdepth.evaluation import Health, SpanKind, Verdict, judge_run
from slamdepth.evaluation.leaps import find_leaps, scene_distance
from slamdepth.geometry import se3_exp
from slamdepth.types import RunStatistics, TrackingStatus, Trajectory


def test_a_steady_path_is_good_and_says_so_in_one_line() -> None:
    health = judge_run(facts())
    assert health.verdict is Verdict.GOOD
    assert health.headline == "Reliable: every frame was tracked (300 of 300), without leaps."
    assert health.reasons == ()
    assert health.spans == ()


def test_a_guessed_camera_that_the_motion_does_not_show_is_a_doubt() -> None:
    health = judge_run(replace(facts(), camera_is_guessed=True))
    assert health.verdict is Verdict.DOUBTFUL
    assert health.headline == "Check this result: the focal length is a guess."
    assert "Give --fov or --camera" in health.reasons[0]


def test_a_verdict_can_be_written_as_json() -> None:
    lost = states(COUNT, (60, 160, TrackingStatus.LOST))
    written = json.loads(json.dumps(judge_run(facts(states=lost)).to_dict()))
    assert list(written) == ["verdict", "headline", "reasons", "spans", "numbers", "maps"]
    assert written["verdict"] == "not trustworthy"
    assert list(written["spans"][0]) == ["from_s", "to_s", "kind", "why"]
    assert written["spans"][0]["kind"] == "lost"


def test_much_of_a_recording_lost_is_not_to_be_trusted_and_is_named_by_its_seconds() -> None:
    health = judge_run(facts(states=states(COUNT, (60, 160, TrackingStatus.LOST))))
    assert health.verdict is Verdict.NOT_TRUSTWORTHY
    assert health.headline == "Do not trust this result: 33 % of the frames were lost (2.0-5.3 s)."
    assert health.numbers.longest_loss_s == pytest.approx(100 / FPS, abs=1e-3)


def test_a_camera_that_is_never_found_again_is_said_to_be() -> None:
    lost_at_the_end = judge_run(facts(states=states(COUNT, (200, COUNT, TrackingStatus.LOST))))
    assert lost_at_the_end.reasons[0].endswith("it was not found again.")
    found = judge_run(facts(states=states(COUNT, (100, 200, TrackingStatus.LOST))))
    assert found.reasons[0].endswith("parts before and after may not fit together.")


def test_a_loss_of_over_a_second_is_a_doubt_and_a_lost_blurred_frame_is_none() -> None:
    long = judge_run(facts(states=states(COUNT, (60, 95, TrackingStatus.LOST))))
    assert long.verdict is Verdict.DOUBTFUL
    assert long.headline.startswith("Check this result: ")
    short = judge_run(facts(states=states(COUNT, (60, 64, TrackingStatus.LOST))))
    assert short.verdict is Verdict.GOOD
    assert short.headline == ("Reliable: 99 % of the frames were tracked, without leaps; no loss over 0.2 s.")
    assert kinds(short) == [SpanKind.LOST]


def test_several_leaps_are_not_to_be_trusted_and_one_is_a_doubt() -> None:
    one = moved_from(walk(), 100, 1.0)
    assert judge_run(facts(one)).verdict is Verdict.DOUBTFUL
    many = moved_from(moved_from(one, 150, -0.8), 200, 0.9)
    health = judge_run(facts(many))
    assert health.verdict is Verdict.NOT_TRUSTWORTHY
    assert health.numbers.leaps == 3
    assert "3 leaps (at 3.3 s, at 5.0 s, at 6.7 s)" in health.headline


def test_one_pose_off_the_path_is_two_leaps_there_and_back() -> None:
    health = judge_run(facts(moved_from(walk(), 100, 1.0, 101)))
    assert kinds(health) == [SpanKind.LEAP, SpanKind.LEAP]
    assert health.verdict is Verdict.DOUBTFUL


def test_a_leap_in_rotation_alone_is_found() -> None:
    poses = walk()
    poses[100:] = poses[100:] @ se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]))
    assert judge_run(facts(poses)).numbers.leaps == 1
    assert judge_run(replace(facts(poses), points_w=np.empty((0, 3)))).numbers.leaps == 1


def test_a_real_quick_turn_is_no_leap() -> None:
    speed_rad = np.full(COUNT, 0.004)
    speed_rad[100:112] = 0.15 * np.sin(np.linspace(0, np.pi, 12)) + 0.004
    angle = np.cumsum(speed_rad)
    zero = np.zeros(COUNT)
    poses = se3_exp(np.stack([zero, zero, zero, zero, angle, zero], axis=1))
    assert speed_rad.max() > 30 * np.median(speed_rad)
    assert judge_run(facts(poses)).verdict is Verdict.GOOD


def test_the_jitter_of_a_camera_that_stands_still_is_no_leap() -> None:
    still = np.broadcast_to(np.eye(4), (COUNT, 4, 4)).copy()
    still[100, 0, 3], still[200, 0, 3] = 0.01, 0.02
    health = judge_run(facts(still))
    assert health.verdict is Verdict.GOOD
    assert health.numbers.leaps == 0


def test_a_camera_that_stands_still_and_is_then_carried_off_makes_no_leap() -> None:
    poses = walk(speed_m=0.0, turn_rad=0.0)
    poses[200:, 0, 3] += 0.15 * np.arange(100)
    assert judge_run(facts(poses)).numbers.leaps == 0


def test_footage_at_two_frames_a_second_is_not_judged_by_leaps_nor_by_its_keyframes() -> None:
    poses = moved_from(walk(60), 30, 1.0)
    health = judge_run(facts(poses, fps=2.0, keyframe_every=1))
    assert health.verdict is Verdict.GOOD
    assert health.numbers.judged_step_share == 0.0
    assert "leaps were not judged" in health.headline
    assert "0.25 s apart" in health.reasons[0]


def test_lengths_are_compared_with_the_distance_of_the_scene() -> None:
    path = moved_from(walk(), 100, 1.0)
    far = facts(path)
    assert len(find_leaps(far.trajectory, 2.0)) == 1
    assert len(find_leaps(far.trajectory, 200.0)) == 0
    distance = scene_distance(facts().trajectory, wall())
    assert distance is not None
    assert 0.5 * SCENE_M < distance < 1.5 * SCENE_M
    assert scene_distance(facts().trajectory, np.empty((0, 3))) is None


def test_few_inliers_for_a_second_are_a_doubt_and_for_most_of_a_run_more_than_that() -> None:
    def with_weak(frames: int) -> Health:
        return judge_run(facts(inliers=[200] * 50 + [25] * frames + [200] * (250 - frames)))

    assert with_weak(15).verdict is Verdict.GOOD
    health = with_weak(45)
    assert health.verdict is Verdict.DOUBTFUL
    assert "weak tracking (1.7-3.2 s)" in health.headline
    assert kinds(health) == [SpanKind.WEAK]
    assert with_weak(200).verdict is Verdict.NOT_TRUSTWORTHY


def test_a_second_before_a_white_wall_is_fine_with_a_sensor_and_a_doubt_with_predictions() -> None:
    wall_states = states(COUNT, (50, 100, TrackingStatus.REGISTERED))
    counts = [200] * 50 + [5] * 50 + [200] * 200
    measured = judge_run(facts(states=wall_states, inliers=counts, depth_is_measured=True))
    assert measured.verdict is Verdict.GOOD
    assert kinds(measured) == [SpanKind.REGISTERED]
    assert len(measured.reasons) == 1
    assert judge_run(facts(states=wall_states, inliers=counts)).verdict is Verdict.DOUBTFUL
    most = states(COUNT, (50, 200, TrackingStatus.REGISTERED))
    assert judge_run(facts(states=most, depth_is_measured=True)).verdict is Verdict.DOUBTFUL


def test_a_long_start_without_a_map_is_a_doubt_and_a_short_one_is_none() -> None:
    late = judge_run(facts(states=states(COUNT, (0, 90, TrackingStatus.INITIALISING))))
    assert late.verdict is Verdict.DOUBTFUL
    assert "no map for 30 % of the frames" in late.headline
    soon = judge_run(facts(states=states(COUNT, (0, 6, TrackingStatus.INITIALISING))))
    assert soon.verdict is Verdict.GOOD
    assert kinds(soon) == [SpanKind.NO_MAP]


def test_a_keyframe_at_every_frame_of_a_video_is_a_doubt() -> None:
    health = judge_run(facts(keyframe_every=1))
    assert health.verdict is Verdict.DOUBTFUL
    assert health.numbers.frames_per_keyframe == 1.0
    assert judge_run(facts(walk(10), keyframe_every=1)).verdict is Verdict.GOOD


def with_loops(
    closed: int, refused: int, *, corrected_m: float = 0.0, weak_frames: int = 0, withdrawn: int = 0
) -> Health:
    """A run of 1.5 m that refused loops; poses of its second half were first placed ``corrected_m`` away."""
    counts = RunStatistics(loop_closures=closed, loops_refused=refused)
    held = [200] * (COUNT - weak_frames) + [50] * weak_frames
    known = facts(inliers=held, statistics=counts, depth_is_measured=True)
    path = known.trajectory
    kept = np.r_[0:60, 60 + withdrawn : COUNT]
    path = Trajectory(path.timestamps_s[kept], path.T_world_camera[kept])
    first = moved_from(walk(), COUNT // 2, corrected_m)
    steps = [replace(step, T_world_camera=first[step.index]) for step in known.steps]
    return judge_run(replace(known, steps=steps, trajectory=path))


def test_loops_refused_by_a_path_that_points_held_and_nothing_corrected_are_no_doubt() -> None:
    health = with_loops(closed=0, refused=20)
    assert health.verdict is Verdict.GOOD
    assert "Places look alike here." in health.reasons[0]
    assert health.maps[0].good_spans_s
    assert with_loops(closed=1, refused=20, corrected_m=0.04).verdict is Verdict.GOOD


def test_loops_refused_by_a_path_that_was_not_tracked_throughout_are_a_doubt() -> None:
    health = with_loops(closed=0, refused=20, withdrawn=1)
    assert health.verdict is Verdict.DOUBTFUL
    assert "where tracking failed" in health.reasons[0]
    assert with_loops(closed=0, refused=0, withdrawn=1).verdict is Verdict.GOOD


def test_loops_refused_by_a_path_that_few_points_held_are_a_doubt() -> None:
    health = with_loops(closed=0, refused=3, weak_frames=40)
    assert health.numbers.weakest_second == 50
    assert health.verdict is Verdict.DOUBTFUL
    assert "few map points held it" in health.reasons[0]
    assert health.maps[0].good_spans_s == ()
    assert with_loops(closed=0, refused=3, weak_frames=10).verdict is Verdict.GOOD
    assert with_loops(closed=0, refused=2, weak_frames=40).verdict is Verdict.GOOD
    assert with_loops(closed=5, refused=4, weak_frames=40).verdict is Verdict.GOOD


def test_loops_refused_by_a_path_that_was_corrected_far_are_a_doubt() -> None:
    health = with_loops(closed=1, refused=3, corrected_m=0.5)
    assert health.numbers.correction_share is not None
    assert 0.08 < health.numbers.correction_share < 0.33
    assert health.verdict is Verdict.DOUBTFUL
    assert "loops and adjustment moved it by" in health.reasons[0]


def test_poses_before_and_after_a_join_are_compared_in_frames_of_their_own() -> None:
    known = facts()
    poses = walk()
    poses[: COUNT // 2, 0, 3] += 20.0  # the frame of a map that was joined later
    steps = [
        replace(step, T_world_camera=poses[step.index], map_id=int(step.index >= COUNT // 2))
        for step in known.steps
    ]
    share = judge_run(replace(known, steps=steps)).numbers.correction_share
    assert share is not None
    assert share < 1e-6


def test_a_recording_of_less_than_a_second_has_no_weakest_second() -> None:
    assert judge_run(facts(walk(20))).numbers.weakest_second is None
    assert judge_run(replace(facts(), steps=())).numbers.weakest_second is None
    still = judge_run(facts(np.broadcast_to(np.eye(4), (COUNT, 4, 4)).copy()))
    assert still.numbers.correction_share is None


def test_keyframes_that_disagree_on_the_scale_are_a_doubt_and_an_outlier_is_none() -> None:
    apart = RunStatistics(scale_votes=(-0.5, -0.4, -0.45, 0.5, 0.6, 0.4))
    assert judge_run(facts(statistics=apart)).verdict is Verdict.DOUBTFUL
    outlier = RunStatistics(scale_votes=(-0.1, 0.0, 0.1, 0.05, -0.05, 2.0))
    assert judge_run(facts(statistics=outlier)).verdict is Verdict.GOOD


def test_a_path_without_a_unit_is_good_in_shape_and_says_so() -> None:
    known = facts()
    health = judge_run(replace(known, trajectory=replace(known.trajectory, is_metric=False)))
    assert health.verdict is Verdict.GOOD
    assert "unit of length is unknown" in health.reasons[0]
    unsure = judge_run(replace(known, scale_is_known=False))
    assert unsure.verdict is Verdict.GOOD
    assert "size of the path is unknown" in unsure.reasons[0]


@pytest.mark.parametrize(("placed", "says"), [(0, "no frame has a pose"), (1, "a single frame has a pose")])
def test_no_path_is_not_to_be_trusted(placed: int, says: str) -> None:
    health = judge_run(facts(states=states(20, (placed, 20, TrackingStatus.LOST)), poses=walk(20)))
    assert health.verdict is Verdict.NOT_TRUSTWORTHY
    assert says in health.headline


def test_the_gravest_reason_comes_first() -> None:
    lost = states(COUNT, (100, 200, TrackingStatus.LOST))
    health = judge_run(facts(states=lost, statistics=RunStatistics(loops_refused=9), inliers=50))
    assert "lost" in health.reasons[0]
    assert "loops" in health.reasons[1]


def test_a_run_without_kept_steps_is_judged_by_its_path() -> None:
    known = facts(moved_from(walk(), 100, 1.0))
    health = judge_run(replace(known, steps=()))
    assert health.numbers.leaps == 1
    assert health.spans[0].to_s == pytest.approx(100 / FPS, abs=1e-3)
