# SPDX-License-Identifier: Apache-2.0
"""A camera that was lost: blanked for seconds, put elsewhere, before white walls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tracking_scene import (
    CONFIG,
    COUNT,
    ConstantDepth,
    Run,
    ate_m,
    colour_only,
    errors_m,
    frames,
    grey,
    played,
)

from slamdepth.config import Config, merge
from slamdepth.geometry import se3_exp
from slamdepth.tracking.relocaliser import RegistrationSchedule
from slamdepth.types import DepthPrediction, Frame, StepResult, TrackingStatus

LOST, REGISTERED = TrackingStatus.LOST, TrackingStatus.REGISTERED
BLANK = 60  # two seconds
SINGLE_MAP = Config.from_dict(merge(CONFIG.model_dump(), {"tracking": {"new_maps": False}}))


def black(frame: Frame) -> Frame:
    return replace(frame, image_rgb=np.zeros_like(frame.image_rgb), depth_m=None)


def placed(results: list[StepResult]) -> list[bool]:
    return [r.T_world_camera is not None for r in results]


@pytest.mark.parametrize("predicted", [False, True])
def test_two_seconds_of_black_frames(predicted: bool) -> None:
    """What follows is tracked in the map from before; only the first camera is aligned."""
    given = played([*frames(range(28)), *[black(f) for f in frames([28] * BLANK)], *frames(range(32, COUNT))])
    run = (
        Run([colour_only(f) for f in given], ConstantDepth(depth_m=1.9, sigma_log=0.3))
        if predicted
        else Run(given)
    )
    assert all(placed(run.results[:28]))
    assert [r.status for r in run.results[28 : 28 + BLANK]] == [LOST] * BLANK
    assert run.results[28 + BLANK].status is TrackingStatus.RELOCALISED
    assert all(placed(run.results[28 + BLANK :]))
    keyframes = run.results[27].keyframes
    if predicted:
        assert run.tracker.finish().statistics.relocalisations == 1
        return
    assert errors_m(run.results)[28:].max() < 0.05
    made = run.finish()
    assert (made.statistics.tracked, made.statistics.relocalisations) == (COUNT - 4, 1)
    assert len(made.keyframes) >= keyframes  # the old map is still there


def test_from_the_middle_to_the_end_and_then_from_the_start() -> None:
    """The start overlaps what was seen, but the jump there is no motion to be tracked."""
    order = [*range(24, 50), *range(24)]
    run = Run(played(frames(order)))
    jump = run.results[26]
    assert jump.index == 0
    assert jump.status in {TrackingStatus.TRACKING, TrackingStatus.RELOCALISED}
    assert all(placed(run.results))
    assert errors_m(run.results).max() < 0.05
    assert run.finish().statistics.tracked == len(order)


def test_a_white_room_is_tracked_from_first_to_last() -> None:
    """Some hundred corners of desk and lamp, and walls without a mark."""
    run = Run(frames(bare=True))
    counts = [len(run.slam.prepare(frame).features) for frame in frames(range(0, COUNT, 9), bare=True)]
    assert np.median(counts) < 200
    assert all(placed(run.results))
    assert np.median(errors_m(run.results)) < 0.05  # single frames jump: their corners lie in one place
    assert ate_m(run.finish().trajectory) < 0.1


def test_a_white_room_is_tracked_without_a_sensor() -> None:
    run = Run(frames(change=colour_only, bare=True), ConstantDepth())
    assert all(placed(run.results))
    assert ate_m(run.finish().trajectory, with_scale=True) < 0.15


def test_a_lost_camera_is_registered_by_depth_alone() -> None:
    """Nothing to see and, for two seconds, no depth either; then depth comes back."""
    given = played(
        [*frames(range(21)), *[black(f) for f in frames([21] * BLANK)], *frames(range(21, 36), grey)]
    )
    run = Run(given)
    assert [r.status for r in run.results[21 : 21 + BLANK]] == [LOST] * BLANK
    after = run.results[21 + BLANK :]
    assert after[0].status in {LOST, REGISTERED}  # every third frame is registered
    assert [r.status for r in after[3:]] == [REGISTERED] * 12
    assert errors_m(run.results).max() < 0.05


def test_depth_of_another_place_is_not_taken_for_the_old_one() -> None:
    given = played([*frames(range(10)), *[black(f) for f in frames([10] * 6)], *frames(range(28, 44), grey)])
    run = Run(given)
    assert errors_m(run.results).max() < 0.05  # lost, or right


class Confused(ConstantDepth):
    """Predicts noise for what it has not seen at the beginning."""

    def predict(self, frame: Frame) -> DepthPrediction:
        made = super().predict(frame)
        if frame.index == 30:
            made.values[:] = np.random.default_rng(self.calls).uniform(0.5, 4.0, made.values.shape)
        return made


def test_a_network_does_not_predict_every_lost_frame() -> None:
    rng = np.random.default_rng(0)
    strange = [
        replace(f, image_rgb=rng.integers(0, 256, f.image_rgb.shape, dtype=np.uint8))
        for f in frames([30] * 48, colour_only)
    ]
    model = Confused()
    run = Run(played([*frames(range(8), colour_only), *strange]), model, SINGLE_MAP)
    assert run.statuses()[LOST] == 48
    keyframes = sum(r.is_keyframe for r in run.results)
    assert model.calls == keyframes + 1 + 7  # when it was lost, and at every sixth frame since

    model = Confused()
    run = Run(played([*frames(range(8), colour_only), *[black(f) for f in frames([30] * 48)]]), model)
    assert run.statuses()[LOST] == 48
    assert model.calls == keyframes  # black frames are not worth a prediction

    model = Confused()
    run = Run(played([*frames(range(8), colour_only), *strange]), model)
    maps = len({r.map_id for r in run.results})
    assert 3 <= maps <= 7  # each waits twice as long for the next as the one before
    assert model.calls <= 2 * maps + 8


class Fitting(ConstantDepth):
    """Predicts for every image what the sensor measures, also for one that shows nothing."""

    def predict(self, frame: Frame) -> DepthPrediction:
        sensor = frames([min(frame.index, COUNT - 1)])[0].depth_m
        assert sensor is not None
        return replace(super().predict(frame), values=sensor)


def test_a_frame_that_shows_nothing_is_not_registered_by_what_a_network_makes_up() -> None:
    """Else it would be a keyframe without features, which has no scale to pass on to the next."""
    given = [black(f) if f.index % 15 == 7 else colour_only(f) for f in frames()]
    run = Run(given, Fitting(sigma_log=0.3))
    statuses = [r.status for r in run.results]
    assert {statuses[n] for n in range(7, COUNT, 15)} == {LOST}
    assert not any(run.results[n].is_keyframe for n in range(7, COUNT, 15))
    assert LOST not in {statuses[n] for n in range(COUNT) if n % 15 != 7}
    assert np.isfinite([keyframe.scale for keyframe in run.slam._active.map.keyframes]).all()


def registered(*, instant: bool, frames: int, **more: bool) -> list[int]:
    """The lost frames that are due, counted from the first lost one as 1."""
    schedule = RegistrationSchedule()
    schedule.start(np.eye(4), np.eye(4))
    found = []
    for lost in range(2, frames):
        schedule.count_frame()
        if schedule.is_due(**{"has_depth": True, "is_instant": instant, **more}):
            found.append(lost)
    return found


def test_registrations_are_scheduled_by_frames_and_end() -> None:
    assert registered(instant=True, frames=14) == [4, 7, 10, 13]
    assert registered(instant=False, frames=20) == [7, 13, 19]
    assert max(registered(instant=True, frames=1000)) == 118
    assert registered(instant=True, frames=200, has_depth=False) == []
    never_lost = RegistrationSchedule()
    never_lost.count_frame()
    assert not never_lost.is_due(has_depth=True, is_instant=True)


def test_the_guess_goes_on_for_two_steps_and_stops() -> None:
    velocity = se3_exp(np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0]))
    start = se3_exp(np.array([0.5, -0.2, 0.1, 0.3, 0.2, 0.1]))
    schedule = RegistrationSchedule()
    schedule.start(start, velocity)
    np.testing.assert_allclose(schedule.guess(), velocity @ start, atol=1e-12)
    for _ in range(40):
        schedule.count_frame()
    D = schedule.guess() @ np.linalg.inv(start)
    np.testing.assert_allclose(D[:3, 3], 2 * velocity[:3, 3], atol=1e-9)


def test_a_place_that_looks_alike_is_tried_before_depth_is_registered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a cut the depth of one place may well fit another's; hundreds of its features do not."""
    run = Run(frames(range(40)))
    tracker = run.slam
    newest = run.results[-1].keyframes - 1
    by_keyframe = tracker._active.localiser.from_keyframe

    def not_from_the_newest(features: Any, k: int, **how: Any) -> Any:
        return None if k == newest else by_keyframe(features, k, **how)

    def elsewhere(*_: Any, **__: Any) -> Any:
        return se3_exp(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))

    monkeypatch.setattr(tracker._active.localiser, "track", lambda *_: None)
    monkeypatch.setattr(tracker._active.localiser, "from_keyframe", not_from_the_newest)
    monkeypatch.setattr(tracker._active.relocaliser._clouds, "register", elsewhere)
    result = tracker.step(played(frames([*range(40), 2]))[-1])
    assert result.status is TrackingStatus.RELOCALISED
    assert result.T_world_camera is not None
    before = run.results[2].T_world_camera
    assert before is not None
    np.testing.assert_allclose(result.T_world_camera, before, atol=0.02)
    assert np.array_equal(tracker._active.motion.step, np.eye(4))


@pytest.mark.parametrize(("kept", "is_believed"), [(30, False), (60, True)])
def test_few_landmarks_of_many_do_not_place_a_lost_camera(kept: int, is_believed: bool) -> None:
    """Thirty of the hundreds of landmarks in view also agree with a wrong pose."""
    run = Run(frames(range(40)))
    localiser, features = run.slam._active.localiser, run.slam.prepare(frames([2])[0]).features
    seen = localiser.from_keyframe(features, 0)
    assert seen is not None
    rng = np.random.default_rng(0)
    chosen = rng.permutation(np.flatnonzero(seen.landmark_ids >= 0))[:kept]
    descriptors = rng.integers(0, 256, features.descriptors.shape, dtype=np.uint8)
    descriptors[chosen] = features.descriptors[chosen]
    few = replace(features, descriptors=descriptors)
    placement = localiser.from_keyframe(few, 0)
    assert placement is not None
    assert kept - 10 <= placement.inliers <= kept + 5
    assert (localiser.from_keyframe(few, 0, is_lost=True) is not None) is is_believed
