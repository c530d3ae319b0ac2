# SPDX-License-Identifier: Apache-2.0
"""The tracker on a rendered walk: how well it does, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracking_scene import (
    CAMERA,
    CONFIG,
    COUNT,
    ConstantDepth,
    Run,
    ate_m,
    colour_only,
    frames,
    grey,
    poses_of,
    truth_of,
    walk,
)

from slamdepth.config import Config
from slamdepth.depth.robust_centre import robust_centre
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import CameraError, ConfigError, TrackingError
from slamdepth.geometry import invert, rotation_angle_rad, transform
from slamdepth.mapping.map import MapKeyframe
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking import CloudTracker, Tracker, create_tracker
from slamdepth.tracking.adjuster import Adjuster, Adjustment
from slamdepth.types import DepthKind, DepthPrediction, Frame, TrackingStatus

GRAVITY_W = np.array([0.1, 0.9, 0.3]) / np.linalg.norm([0.1, 0.9, 0.3])


@pytest.fixture(scope="module")
def sensor_run() -> tuple[Run, Reconstruction]:
    run = Run(frames())
    return run, run.finish()


@pytest.fixture(scope="module")
def constant_run() -> tuple[Run, Reconstruction]:
    run = Run(frames(change=colour_only), ConstantDepth())
    return run, run.finish()


def test_sensor_depth_tracks_every_frame_in_metres(sensor_run: tuple[Run, Reconstruction]) -> None:
    run, reconstruction = sensor_run
    assert run.statuses() == {TrackingStatus.TRACKING: COUNT}
    assert ate_m(reconstruction.trajectory) < 0.012
    truth = truth_of(reconstruction.trajectory)
    turned = rotation_angle_rad((invert(reconstruction.trajectory.T_world_camera) @ truth)[:, :3, :3])
    assert np.degrees(turned).max() < 1.0


def test_a_constant_prior_tracks_every_frame_up_to_scale(constant_run: tuple[Run, Reconstruction]) -> None:
    run, reconstruction = constant_run
    assert run.statuses() == {TrackingStatus.TRACKING: COUNT}
    assert ate_m(reconstruction.trajectory, with_scale=True) < 0.02
    votes = reconstruction.statistics.scale_votes
    assert 2 <= len(votes) <= len(reconstruction.keyframes)
    assert abs(robust_centre(np.array(votes))) < 1e-9
    assert np.std(votes) > 0.01


def test_the_reconstruction_is_consistent(
    sensor_run: tuple[Run, Reconstruction], constant_run: tuple[Run, Reconstruction]
) -> None:
    for run, made in (sensor_run, constant_run):
        trajectory = made.trajectory
        np.testing.assert_array_equal(trajectory.timestamps_s, [f.timestamp_s for f in walk()[0]])
        assert (np.diff(trajectory.timestamps_s) > 0).all()
        np.testing.assert_allclose(trajectory.T_world_camera[0], np.eye(4), atol=1e-12)
        R = trajectory.T_world_camera[:, :3, :3]
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
        statistics = made.statistics
        assert statistics.frames == statistics.tracked == len(trajectory) == COUNT
        assert statistics.relocalisations == statistics.registrations == statistics.loop_closures == 0
        assert len(made.keyframes) == run.results[-1].keyframes == sum(r.is_keyframe for r in run.results)
        assert 3 <= len(made.keyframes) <= COUNT // 4
        assert [k.id for k in made.keyframes] == list(range(len(made.keyframes)))
        keyframe_indices = [r.index for r in run.results if r.is_keyframe]
        assert [k.frame.index for k in made.keyframes] == keyframe_indices
        for k in made.keyframes:
            np.testing.assert_allclose(k.T_world_camera, trajectory.T_world_camera[k.frame.index], atol=1e-9)
            assert k.load_depth_m().shape == (CAMERA.height, CAMERA.width)
            assert k.load_depth_m().dtype == np.float32
            assert np.isfinite(k.load_depth_m()).all()
            assert (k.load_depth_m() > 0).mean() > 0.9
            assert k.keypoints_px.shape[1] == 2
            assert 0.3 < k.depth_scale < 3.0
        assert made.points_m.shape[1] == 3
        assert len(made.points_m) > 200
        assert np.isfinite(made.points_m).all()
        assert set(made.statistics.timings_ms) >= {"features", "tracking", "depth", "mapping", "bundle"}
        assert all(ms >= 0 for ms in made.statistics.timings_ms.values())
        assert made.statistics.timing_calls.keys() == made.statistics.timings_ms.keys()
        assert made.statistics.timing_calls["features"] == COUNT
        assert made.statistics.timing_calls["final"] == 1


class WithGravity(ConstantDepth):
    """Estimates ``GRAVITY_W`` in each image, as the true camera would see it."""

    def predict(self, frame: Frame) -> DepthPrediction:
        R_world_camera = walk()[1][frame.index][:3, :3]
        return replace(super().predict(frame), gravity=R_world_camera.T @ GRAVITY_W, gravity_share=0.8)


def test_gravity_estimated_in_the_images_is_passed_on_in_the_world(
    sensor_run: tuple[Run, Reconstruction], constant_run: tuple[Run, Reconstruction]
) -> None:
    made = Run(frames(change=colour_only), WithGravity()).finish()
    assert made.gravity_w is not None
    assert np.linalg.norm(made.gravity_w) == pytest.approx(1.0)
    assert made.gravity_w @ GRAVITY_W > np.cos(np.radians(1.0))
    np.testing.assert_array_equal(  # the model makes no use of it: nothing else may change
        made.trajectory.T_world_camera, constant_run[1].trajectory.T_world_camera
    )
    assert sensor_run[1].gravity_w is constant_run[1].gravity_w is None


def test_steps_say_what_was_done(sensor_run: tuple[Run, Reconstruction]) -> None:
    run, _ = sensor_run
    assert [r.index for r in run.results] == list(range(COUNT))
    assert run.results[0].is_keyframe
    for result in run.results:
        assert result.T_world_camera is not None
        assert result.inliers >= CONFIG.tracking.min_inliers
        assert result.timings_ms["features"] > 0
        assert "mapping" in result.timings_ms or not result.is_keyframe
    totals = [r.keyframes for r in run.results]
    assert sum("bundle" in r.timings_ms for r in run.results) >= totals[-1] - 2
    assert totals == sorted(totals)
    online = poses_of(run.results)
    assert np.linalg.norm(online[:, :3, 3] - walk()[1][:, :3, 3], axis=1).max() < 0.04


def test_landmarks_lie_on_the_surfaces(sensor_run: tuple[Run, Reconstruction]) -> None:
    """Seen from the true cameras, most landmarks are where the depth images say."""
    _, made = sensor_run
    frame, T_world_camera = walk()[0][0], walk()[1][0]
    P = transform(invert(T_world_camera), made.points_m)
    u = np.rint(CAMERA.fx * P[:, 0] / P[:, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * P[:, 1] / P[:, 2] + CAMERA.cy).astype(int)
    inside = (P[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
    assert frame.depth_m is not None
    error = np.abs(P[inside, 2] / frame.depth_m[v[inside], u[inside]] - 1.0)
    assert inside.sum() > 100
    assert np.median(error) < 0.01


def test_the_constant_prior_was_aligned_to_the_scene(constant_run: tuple[Run, Reconstruction]) -> None:
    """Landmarks correct the prediction: the final depth is nearer the truth, up to one scale."""
    _, made = constant_run
    spread = []
    for k in made.keyframes[1:]:
        truth = walk()[0][k.frame.index].depth_m
        assert truth is not None
        before, after = np.log(k.prediction.load().values / truth), np.log(k.load_depth_m() / truth)
        spread.append((before.std(), after.std()))
    before, after = np.mean(spread, axis=0)
    assert after < 0.8 * before


def test_the_same_input_gives_the_same_bits(sensor_run: tuple[Run, Reconstruction]) -> None:
    _, first = sensor_run
    again = Run(frames()).finish()
    np.testing.assert_array_equal(again.trajectory.T_world_camera, first.trajectory.T_world_camera)
    np.testing.assert_array_equal(again.points_m, first.points_m)


def test_a_start_in_the_middle() -> None:
    run = Run(frames(range(30, COUNT)))
    made = run.finish()
    assert run.statuses() == {TrackingStatus.TRACKING: COUNT - 30}
    np.testing.assert_allclose(made.trajectory.T_world_camera[0], np.eye(4), atol=1e-12)
    assert ate_m(made.trajectory) < 0.012


def test_every_third_frame_is_enough() -> None:
    run = Run(frames(range(0, COUNT, 3)))
    assert run.statuses() == {TrackingStatus.TRACKING: (COUNT + 2) // 3}
    assert ate_m(run.finish().trajectory) < 0.012


def test_kiss_icp_behind_the_same_interface() -> None:
    run = Run(frames(range(30)), config=Config.from_dict({"odometry": "kiss-icp"}))
    assert isinstance(run.tracker, CloudTracker)
    assert run.statuses() == {TrackingStatus.TRACKING: 30}
    made = run.finish()
    assert ate_m(made.trajectory) < 0.005
    assert made.statistics.tracked == len(made.trajectory) == 30
    assert len(made.keyframes) == run.results[-1].keyframes >= 1
    with pytest.raises(TrackingError, match="finished"):
        run.tracker.step(frames([40])[0])


def test_create_tracker_takes_the_named_odometry() -> None:
    assert isinstance(create_tracker(CAMERA, SensorDepth()), Tracker)
    assert isinstance(create_tracker(CAMERA, config=Config.from_dict({"depth": {"name": "sensor"}})), Tracker)
    with pytest.raises(ConfigError, match="unknown depth model"):
        Tracker(CAMERA, config=Config.from_dict({"depth": {"name": "sonar"}}))
    with pytest.raises(ConfigError, match="no feature is called"):
        Tracker(CAMERA, SensorDepth(), Config.from_dict({"features": {"name": "surf"}}))


@pytest.mark.parametrize("odometry", ["orb", "kiss-icp"])
def test_what_a_tracker_refuses(odometry: str) -> None:
    tracker = create_tracker(CAMERA, SensorDepth(), CONFIG.model_copy(update={"odometry": odometry}))
    with pytest.raises(TrackingError, match="no frame could be placed"):
        tracker.finish()
    first, second = frames([3, 4])
    tracker.step(first)
    for time_s in (first.timestamp_s, first.timestamp_s - 1.0, float("nan")):
        with pytest.raises(TrackingError, match="time must increase"):
            tracker.step(replace(second, timestamp_s=time_s))
    other = replace(CAMERA, fx=CAMERA.fx + 1.0)
    with pytest.raises(CameraError, match="another camera"):
        tracker.step(replace(second, camera=other))
    assert tracker.step(second).status is TrackingStatus.TRACKING  # none of that did any harm
    assert tracker.finish().statistics.tracked == 2
    with pytest.raises(TrackingError, match="finished"):
        tracker.finish()
    with pytest.raises(TrackingError, match="finished"):
        tracker.step(frames([5])[0])


class RelativeDepth(ConstantDepth):
    kind = DepthKind.AFFINE_INVERSE_DEPTH

    def predict(self, frame: Frame) -> DepthPrediction:
        return replace(super().predict(frame), kind=self.kind)


def test_relative_depth_is_refused_before_anything_is_built_on_it() -> None:
    with pytest.raises((ConfigError, TrackingError), match="metric"):
        Tracker(CAMERA, RelativeDepth(), CONFIG)


@pytest.mark.parametrize("indices", [[0], [0, 12]])
@pytest.mark.parametrize("predicted", [False, True])
def test_a_run_may_end_at_once(indices: list[int], predicted: bool) -> None:
    made = Run(frames(indices), ConstantDepth() if predicted else None).finish()
    assert made.statistics.tracked == len(indices)
    assert len(made.keyframes) >= 1
    assert made.keyframes[0].load_depth_m().shape == (CAMERA.height, CAMERA.width)
    assert made.points_m.shape[1] == 3


def test_nothing_to_see_at_all() -> None:
    run = Run(frames(range(5), grey))
    assert run.statuses() == {TrackingStatus.INITIALISING: 5}
    assert all(r.T_world_camera is None for r in run.results)
    with pytest.raises(TrackingError, match="no frame could be placed"):
        run.finish()


def test_the_network_runs_on_keyframes_only() -> None:
    model = ConstantDepth()
    run = Run(frames(range(20), colour_only), model)
    assert model.calls == run.results[-1].keyframes


def test_what_a_network_says_of_its_errors_can_be_ignored() -> None:
    def trajectory(sigma_log: float, *, is_used: bool) -> np.ndarray:
        config = Config.from_dict({**CONFIG.model_dump(), "depth": {"uncertainty": is_used}})
        run = Run(frames(range(30), change=colour_only), ConstantDepth(sigma_log=sigma_log), config)
        return run.finish().trajectory.T_world_camera

    np.testing.assert_array_equal(trajectory(0.1, is_used=False), trajectory(0.45, is_used=False))
    assert not np.array_equal(trajectory(0.1, is_used=True), trajectory(0.45, is_used=True))


def test_local_adjustment_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    begin_window = Adjuster.begin_window

    def counted(self: Adjuster, keyframe: MapKeyframe) -> Adjustment | None:
        adjustment = begin_window(self, keyframe)
        if adjustment is not None:
            begun.append(keyframe.id)
        return adjustment

    monkeypatch.setattr(Adjuster, "begin_window", counted)
    for is_local in (True, False):
        begun.clear()
        config = Config.from_dict({**CONFIG.model_dump(), "bundle": {"local": is_local, "final": False}})
        run = Run(frames(range(30)), config=config)
        assert run.finish().trajectory.timestamps_s.shape == (30,)
        assert bool(begun) is is_local
