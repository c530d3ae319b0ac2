# SPDX-License-Identifier: Apache-2.0
"""The tracker when frames are blank, dark, without depth or senseless."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tracking_scene import (
    COUNT,
    Change,
    ConstantDepth,
    Run,
    ate_m,
    colour_only,
    covered,
    frames,
    grey,
    poses_of,
    position_errors_m,
)

from slamdepth.config import Config
from slamdepth.types import DepthPrediction, Frame, TrackingStatus

TRACKING, LOST = TrackingStatus.TRACKING, TrackingStatus.LOST
INITIALISING = TrackingStatus.INITIALISING


def between(first: int, last: int, change: Change) -> Change:
    """``change`` for the frames ``first`` to ``last``, the others as they are."""
    return lambda frame: change(frame) if first <= frame.index <= last else frame


def without_depth(frame: Frame) -> Frame:
    return replace(frame, depth_m=None)


def zero_depth(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def too_far(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.full_like(frame.depth_m, 50.0))


def dark(frame: Frame) -> Frame:
    """Out of focus, at dusk."""
    return replace(frame, image_rgb=(0.2 * cv2.GaussianBlur(frame.image_rgb, (0, 0), 9)).astype(np.uint8))


@pytest.mark.parametrize("spoil", [grey, without_depth, zero_depth, too_far])
def test_it_starts_with_the_first_usable_frame(spoil: Change) -> None:
    run = Run(frames(range(25), between(0, 3, spoil)))
    assert [r.status for r in run.results] == [INITIALISING] * 4 + [TRACKING] * 21
    assert all(r.T_world_camera is None for r in run.results[:4])
    made = run.finish()
    assert (made.statistics.frames, made.statistics.tracked) == (25, 21)
    assert made.keyframes[0].frame.index == 4
    assert ate_m(made.trajectory) < 0.012


def test_a_prior_too_uncertain_to_create_landmarks_is_not_called_tracking() -> None:
    run = Run(frames(range(6), colour_only), ConstantDepth(sigma_log=2.0))
    assert run.statuses() == {INITIALISING: 6}


@pytest.mark.parametrize("predicted", [False, True])
def test_a_hand_over_the_lens(predicted: bool) -> None:
    """Lost while nothing is seen, then relocalised in the same map."""
    change = between(30, 44, covered)
    given = frames(change=(lambda f: colour_only(change(f))) if predicted else change)
    run = Run(given, ConstantDepth() if predicted else None)
    for result in run.results:
        if 30 <= result.index <= 44:
            assert result.status is LOST
            assert result.T_world_camera is None
            assert not result.is_keyframe
    assert run.status_of(45) is TrackingStatus.RELOCALISED
    assert [r.status for r in run.results[46:]] == [TRACKING] * (COUNT - 46)
    before = run.results[29].keyframes
    made = run.finish()
    assert [k.frame.index for k in made.keyframes[:before]] == [
        r.index for r in run.results[:30] if r.is_keyframe
    ]
    done = made.statistics
    assert (done.frames, done.tracked, done.relocalisations) == (COUNT, COUNT - 15, 1)
    assert ate_m(made.trajectory, with_scale=predicted) < (0.025 if predicted else 0.02)
    if not predicted:
        assert position_errors_m(made.trajectory)[-10:].max() < 0.05


def test_dark_frames_are_registered_by_their_depth() -> None:
    run = Run(frames(range(50), between(30, 34, dark)))
    for index in range(30, 35):
        assert run.status_of(index) in {TRACKING, TrackingStatus.REGISTERED}
    assert run.statuses()[TrackingStatus.REGISTERED] >= 3
    online = {r.index: r.T_world_camera for r in run.results}
    made = run.finish()
    assert made.statistics.tracked == 50
    assert made.statistics.registrations == run.statuses()[TrackingStatus.REGISTERED]
    errors = position_errors_m(made.trajectory)
    assert errors[30:35].max() < 0.03
    assert all(T is not None for T in online.values())
    assert ate_m(made.trajectory) < 0.015


def test_frames_without_a_feature_before_a_rolling_shutter() -> None:
    """The distance of a pixel is unknown where the frame before was placed by registration alone."""
    config = Config.from_dict({"shutter": {"readout_ms": 20}})
    run = Run(frames(range(40), between(30, 33, grey)), config=config)
    assert run.status_of(31) is TrackingStatus.REGISTERED
    assert len(run.finish().trajectory) == 40


def test_after_dark_frames_the_map_grows_again() -> None:
    """A keyframe that saw nothing is no reference for the overlap."""
    usual = Run(frames(range(50))).results
    after = Run(frames(range(50), between(30, 34, dark))).results
    assert np.median([r.inliers for r in after[37:]]) > 0.7 * np.median([r.inliers for r in usual[37:]])


def test_standing_before_a_white_wall_is_no_reason_for_keyframes() -> None:
    """Depth goes on, so frames are registered; but where the view stays the same one keyframe will do."""
    given = frames(range(21))
    last = given[-1]
    given += [
        replace(grey(last), index=20 + i, timestamp_s=last.timestamp_s + 0.03 * i) for i in range(1, 13)
    ]
    run = Run(given)
    assert [r.status for r in run.results[21:]] == [TrackingStatus.REGISTERED] * 12
    assert run.results[-1].keyframes <= run.results[20].keyframes + 2
    poses = poses_of(run.results[20:])
    assert np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max() < 0.02


def test_depth_in_some_frames_only() -> None:
    run = Run(frames(change=lambda f: f if f.index % 4 == 0 else without_depth(f)))
    assert run.statuses() == {TRACKING: COUNT}
    assert all(r.index % 4 == 0 for r in run.results if r.is_keyframe)
    assert ate_m(run.finish().trajectory) < 0.015


def test_holes_and_nonsense_in_the_depth() -> None:
    def holes(frame: Frame) -> Frame:
        rng = np.random.default_rng(frame.index)
        assert frame.depth_m is not None
        depth = frame.depth_m.copy()
        depth[rng.random(depth.shape) < 0.3] = np.nan
        depth[rng.random(depth.shape) < 0.1] = 0.0
        depth[rng.random(depth.shape) < 0.01] = np.inf
        depth[rng.random(depth.shape) < 0.01] = -1.0
        return replace(frame, depth_m=depth)

    run = Run(frames(range(30), holes))
    assert run.statuses() == {TRACKING: 30}
    made = run.finish()
    assert ate_m(made.trajectory) < 0.012
    for k in made.keyframes:
        assert np.isfinite(k.load_depth_m()).all()
        assert (k.load_depth_m() >= 0).all()


def test_a_network_with_holes() -> None:
    class Holes(ConstantDepth):
        def predict(self, frame: Frame) -> DepthPrediction:
            made = super().predict(frame)
            made.values[::2] = np.nan
            made.values[:, 200:210] = 0.0
            return made

    run = Run(frames(range(30), colour_only), Holes())
    assert run.statuses() == {TRACKING: 30}
    made = run.finish()
    assert ate_m(made.trajectory, with_scale=True) < 0.02
    assert all(np.isfinite(k.load_depth_m()).all() for k in made.keyframes)


def test_a_network_without_uncertainty() -> None:
    class Silent(ConstantDepth):
        def predict(self, frame: Frame) -> DepthPrediction:
            return replace(super().predict(frame), sigma_log=None)

    run = Run(frames(range(30), colour_only), Silent())
    assert run.statuses() == {TRACKING: 30}
    made = run.finish()
    assert ate_m(made.trajectory, with_scale=True) < 0.03


def test_a_jump_is_not_tracked_as_motion() -> None:
    """Frames are missing: the view jumps, and is placed by what it shows, not by extrapolation."""
    run = Run(frames([*range(20), *range(40, COUNT)]))
    assert all(r.T_world_camera is not None for r in run.results)
    assert ate_m(run.finish().trajectory) < 0.015


class SometimesSenseless(ConstantDepth):
    """Every fourth prediction has hills and holes that are not there, with the usual deviation."""

    def predict(self, frame: Frame) -> DepthPrediction:
        prediction = super().predict(frame)
        if self.calls % 4:
            return prediction
        noise = np.random.default_rng(self.calls).normal(size=(9, 12)).astype(np.float32)
        hills = cv2.resize(noise, prediction.values.shape[::-1], interpolation=cv2.INTER_CUBIC)
        return replace(prediction, values=prediction.values * np.exp(1.6 * hills))


def test_whole_predictions_that_disagree_with_the_map_are_dropped() -> None:
    model = SometimesSenseless(sigma_log=0.3)
    run = Run(frames(change=colour_only), model)
    made = run.finish()
    assert run.statuses() == {TRACKING: COUNT}
    empty = [keyframe.id for keyframe in made.keyframes if not keyframe.prediction.load().values.any()]
    assert empty  # not the fourth keyframe: the map knows too little by then
    assert all(id % 4 == 3 for id in empty)
    assert any(f"{len(empty)} predicted depth maps disagreed" in note for note in made.notes)
    assert not any(made.keyframes[k].load_depth_m().any() for k in empty)
    assert ate_m(made.trajectory, with_scale=True) < 0.02
    honest = Run(frames(change=colour_only), ConstantDepth(sigma_log=0.3)).finish()
    assert all(keyframe.prediction.load().values.any() for keyframe in honest.keyframes)
