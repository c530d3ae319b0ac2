# SPDX-License-Identifier: Apache-2.0
"""Which poses are earned, which wait to be confirmed, and which are none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import poisson
from tracking_scene import CAMERA, ConstantDepth, Run, colour_only, frames, grey, played

from slamdepth.frontend.features import Features
from slamdepth.geometry import se3_exp
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.pose_check import PoseCheck, Verdict, chance_log
from slamdepth.typing import Floats, Ints

FPS = 30.0


class Scene:
    """A map after some frames, and the next frame placed in it."""

    def __init__(self) -> None:
        self.run = Run(frames(range(20)))
        slam = self.run.slam
        tracked = slam._active
        self.check = PoseCheck(CAMERA, tracked.map, tracked.localiser)
        self.features: Features = slam.prepare(frames([20])[0]).features
        self.T_guess = tracked.motion.predict(20 / FPS)
        placement = tracked.localiser.track(self.features, self.T_guess, self._recent())
        assert placement is not None
        self.placement = placement
        assert self.judged(0).verdict is Verdict.EARNED

    def _recent(self) -> Ints:
        ids = self.run.slam._active.motion.landmark_ids
        return np.unique(ids[ids >= 0])

    def judged(self, n: int, placement: Placement | None = None, off: Floats | None = None):  # type: ignore[no-untyped-def]
        """Judge the ``n``-th of the frames from here; ``off (6,)`` moves the predicted pose."""
        T_guess = self.T_guess if off is None else se3_exp(off) @ self.T_guess
        return self.check.judge(n / FPS, self.features, placement or self.placement, T_guess)

    def only(self, keep: Ints) -> Placement:
        """The placement with the agreeing features ``keep`` alone."""
        ids = np.full_like(self.placement.landmark_ids, -1)
        ids[keep] = self.placement.landmark_ids[keep]
        return replace(self.placement, landmark_ids=ids)

    @property
    def agreeing(self) -> Ints:
        return np.flatnonzero(self.placement.landmark_ids >= 0)


@pytest.fixture(scope="module")
def rendered() -> Scene:
    return Scene()


@pytest.fixture
def scene(rendered: Scene) -> Scene:
    tracked = rendered.run.slam._active
    rendered.check = PoseCheck(CAMERA, tracked.map, tracked.localiser)
    rendered.judged(0)
    return rendered


@pytest.mark.parametrize(("matches", "expected"), [(20, 1.0), (20, 5.0), (60, 12.0), (12, 9.0)])
def test_the_bound_on_chance_lies_above_the_poisson_tail(matches: int, expected: float) -> None:
    tail = poisson.logsf(matches - 1, expected)
    assert tail <= chance_log(matches, expected) <= tail + 4.0


def test_no_more_matches_than_expected_are_no_surprise() -> None:
    assert chance_log(3, 3.0) == 0.0
    assert chance_log(2, 3.0) == 0.0
    assert chance_log(1, 0.0) == -math.inf


def test_few_matches_all_over_the_image_are_enough(scene: Scene) -> None:
    """Twenty landmarks that agree are far above chance in a rendered room."""
    spread = scene.agreeing[:: max(1, len(scene.agreeing) // 24)]
    assert len(spread) < 60
    assert scene.judged(1, scene.only(spread)).verdict is Verdict.EARNED


def test_matches_of_a_single_point_are_no_pose(scene: Scene) -> None:
    one = scene.only(scene.agreeing[:24])
    ids = np.where(one.landmark_ids >= 0, one.landmark_ids[scene.agreeing[0]], -1)
    judgement = scene.judged(1, replace(one, landmark_ids=ids))
    assert judgement.verdict is Verdict.LOST
    assert judgement.why == "the matches do not determine the pose"


def test_matches_as_frequent_as_by_chance_are_no_pose(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Landmarks that are sought elsewhere agree as often: here the search finds any feature right there."""
    few = scene.only(scene.agreeing[:: max(1, len(scene.agreeing) // 24)])

    def finds_all(visible, features, *_):  # type: ignore[no-untyped-def]
        count = min(len(visible.ids), len(features), 200)
        features.px[:count] = visible.px[:count]
        return visible.ids[:count], np.arange(count), np.zeros(count, np.int64)

    px = scene.features.px.copy()
    monkeypatch.setattr(scene.check._localiser, "search", finds_all)
    judgement = scene.judged(1, few)
    scene.features.px[:] = px
    assert judgement.verdict is Verdict.LOST
    assert judgement.why == "chance would give as many matches"


def test_a_pose_where_no_camera_gets_in_time_waits_for_three_frames(scene: Scene) -> None:
    off = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])  # 0.4 rad in a thirtieth of a second: 360 rad/s^2
    verdicts = [scene.judged(1, off=off), *(scene.judged(n) for n in range(2, 6))]
    assert [judgement.verdict for judgement in verdicts] == [
        *[Verdict.PROVISIONAL] * 3, Verdict.EARNED, Verdict.EARNED,
    ]  # fmt: skip
    assert not any(judgement.withdrawn_s for judgement in verdicts)


def test_the_same_step_is_possible_at_five_frames_a_second(scene: Scene) -> None:
    off = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    assert scene.judged(6, off=off).verdict is Verdict.EARNED


def test_a_leap_back_withdraws_what_waited(scene: Scene) -> None:
    off = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    scene.judged(1, off=off)
    scene.judged(2)
    judgement = scene.judged(3, off=-off)
    assert judgement.verdict is Verdict.PROVISIONAL
    assert judgement.withdrawn_s == (1 / FPS, 2 / FPS)
    assert scene.check.is_provisional


def test_a_loss_withdraws_what_waited(scene: Scene) -> None:
    off = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    scene.judged(1, off=off)
    assert scene.check.lose() == (1 / FPS,)
    assert not scene.check.is_provisional
    assert scene.check.lose() == ()


def test_a_second_confirms_at_any_frame_rate(scene: Scene) -> None:
    few = scene.only(scene.agreeing[:: max(1, len(scene.agreeing) // 24)])
    check, features = scene.check, scene.features
    assert check.judge(5.0, features, few, None).verdict is Verdict.PROVISIONAL
    assert check.judge(5.6, features, few, scene.T_guess).verdict is Verdict.PROVISIONAL
    assert check.judge(6.2, features, few, scene.T_guess).verdict is Verdict.EARNED


def test_after_a_loss_many_matches_are_enough(scene: Scene) -> None:
    check, features = scene.check, scene.features
    assert check.judge(5.0, features, scene.placement, None).verdict is Verdict.EARNED
    few = scene.only(scene.agreeing[:: max(1, len(scene.agreeing) // 24)])
    assert check.judge(6.0, features, few, None).verdict is Verdict.PROVISIONAL


def test_a_frame_placed_by_its_depth_needs_no_matches(scene: Scene) -> None:
    none = replace(scene.only(np.zeros(0, np.int64)), placed_by=PlacedBy.REGISTRATION)
    assert scene.judged(1, none).verdict is Verdict.EARNED


def test_a_walk_is_earned_from_first_to_last(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []
    real = PoseCheck.judge

    def judge(self, *arguments):  # type: ignore[no-untyped-def]
        judged.append(real(self, *arguments))
        return judged[-1]

    monkeypatch.setattr(PoseCheck, "judge", judge)
    run = Run(frames(range(40), colour_only), ConstantDepth(depth_m=1.9, sigma_log=0.3))
    assert {judgement.verdict for judgement in judged} == {Verdict.EARNED}
    assert len(judged) == 39
    assert run.finish().statistics.withdrawn == 0


def test_poses_that_wait_when_the_camera_is_lost_leave_the_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Frames 20 and 21 wait, the hand before the lens follows: they have no pose in the end."""
    real = PoseCheck._suspicion

    def suspicion(self, duration_s, features, placement, T_guess):  # type: ignore[no-untyped-def]
        found = real(self, duration_s, features, placement, T_guess)
        return found or ("made up" if self._last_s == 20 / FPS else "")

    monkeypatch.setattr(PoseCheck, "_suspicion", suspicion)
    given = played([*frames(range(22)), *frames([22] * 5, grey), *frames(range(24, 40))])
    given = [replace(frame, depth_m=None) if 22 <= n < 27 else frame for n, frame in enumerate(given)]
    run = Run(given)
    assert not run.results[20].is_keyframe
    times_s = run.finish()
    kept = times_s.trajectory.timestamps_s.tolist()
    assert given[19].timestamp_s in kept
    assert given[20].timestamp_s not in kept
    assert given[21].timestamp_s not in kept
    assert times_s.statistics.withdrawn == 2
