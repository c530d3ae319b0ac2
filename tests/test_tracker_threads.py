# SPDX-License-Identifier: Apache-2.0
"""What runs in parallel to the tracker: however slow it is, the result is the same."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from tracking_scene import CAMERA, CONFIG, COUNT, ConstantDepth, Run, ate_m, colour_only, frames

from slamdepth.backend.bundle_problem import BundleResult
from slamdepth.config import Config
from slamdepth.errors import CameraError
from slamdepth.geometry import invert, se3_exp, so3_exp, transform
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import Placement
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.thread_limits import single_threaded
from slamdepth.tracking import Tracker, workers
from slamdepth.tracking.motion import MotionModel
from slamdepth.types import DepthPrediction, Frame, TrackingStatus


class LateDepth(ConstantDepth):
    """Takes its time, another one for each frame."""

    def __init__(self, seed: int, most_s: float) -> None:
        super().__init__()
        self._random, self._most_s = np.random.default_rng(seed), most_s
        self.threads: set[str] = set()

    def predict(self, frame: Frame) -> DepthPrediction:
        self.threads.add(threading.current_thread().name)
        time.sleep(self._random.uniform(0.0, self._most_s))
        return super().predict(frame)


def delayed(frames_late: int) -> Config:
    return CONFIG.model_copy(
        update={"tracking": CONFIG.tracking.model_copy(update={"depth_delay": frames_late})}
    )


@lru_cache(maxsize=1)
def prompt() -> tuple[Run, Reconstruction]:
    run = Run(frames(change=colour_only), LateDepth(0, 0.0))
    return run, run.finish()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_slow_network_changes_nothing(seed: int) -> None:
    run, expected = prompt()
    slow = Run(frames(change=colour_only), LateDepth(seed, 0.3))
    made = slow.finish()
    np.testing.assert_array_equal(made.trajectory.T_world_camera, expected.trajectory.T_world_camera)
    np.testing.assert_array_equal(made.points_m, expected.points_m)
    for one, other in zip(run.results, slow.results, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        assert one.is_keyframe == other.is_keyframe


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_threads_change_nothing(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adjustments, readout times, visual words and the growing map are taken over at counted frames."""
    _, expected = prompt()
    random, at_once, names = np.random.default_rng(seed), workers._single_threaded, set()

    def late(task: Callable[[], Any]) -> Any:
        names.add(threading.current_thread().name)
        time.sleep(random.uniform(0.0, 0.2))
        return at_once(task)

    monkeypatch.setattr(workers, "_single_threaded", late)
    made = Run(frames(change=colour_only), LateDepth(0, 0.0)).finish()
    assert names == {"slamdepth-side_0", "slamdepth-between_0"}
    np.testing.assert_array_equal(made.trajectory.T_world_camera, expected.trajectory.T_world_camera)
    np.testing.assert_array_equal(made.points_m, expected.points_m)


def test_a_keyframe_made_while_a_window_is_adjusted_moves_along() -> None:
    run = Run(frames(range(60), colour_only), LateDepth(0, 0.0))
    map_, integration = run.slam._active.map, run.slam._active.integration
    run.slam._workers.between.wait()
    integration.run_all()
    newest = map_.keyframes[-1]
    adjustment = integration.adjuster.begin_window(newest)
    assert adjustment is not None
    solved = adjustment.result.result()
    T_made = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.05, 0.0])) @ newest.T_camera_world
    made = map_.add_keyframe(newest.frame.load(), newest.features, T_made, newest.landmark_ids)
    T_made_newest = T_made @ newest.T_world_camera
    shift = se3_exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.03]))
    moved = solved.T_camera_world @ shift
    done: Future[BundleResult] = Future()
    done.set_result(replace(solved, T_camera_world=moved, points_w=transform(invert(shift), solved.points_w)))
    before = newest.T_camera_world
    integration.adjuster.complete(replace(adjustment, result=done))
    assert np.abs(newest.T_camera_world - before).max() > 0.01
    np.testing.assert_allclose(made.T_camera_world @ newest.T_world_camera, T_made_newest, atol=1e-12)


class Inside:
    """A thread that is inside ``single_threaded`` until it is asked to leave."""

    def __init__(self) -> None:
        self._inside, self._leave = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._stay)

    def _stay(self) -> None:
        with single_threaded():
            self._inside.set()
            self._leave.wait(10.0)

    def enter(self) -> None:
        self._thread.start()
        assert self._inside.wait(10.0)

    def leave(self) -> None:
        self._leave.set()
        self._thread.join()


def test_the_last_to_leave_restores_the_number_of_threads() -> None:
    cv2.setNumThreads(2)
    other = Inside()
    with single_threaded():
        other.enter()
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == 1
    other.leave()
    assert cv2.getNumThreads() == 2


def numbers_of_threads() -> list[int]:
    blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
    assert blas
    return [cv2.getNumThreads(), *blas]


@pytest.mark.parametrize("first_to_leave", [0, 1])
def test_one_thread_computes_whoever_enters_first_and_leaves_last(first_to_leave: int) -> None:
    """OpenBLAS sums in an order that depends on its threads: trajectories would differ in the last bits."""
    import scipy.linalg  # noqa: F401

    cv2.setNumThreads(2)
    with threadpool_limits(limits=2, user_api="blas"):
        before = numbers_of_threads()
        with single_threaded():
            assert set(numbers_of_threads()) == {1}
        for _ in range(2):
            others = [Inside(), Inside()]
            others[0].enter()
            assert set(numbers_of_threads()) == {1}
            others[1].enter()
            with single_threaded():
                others[first_to_leave].leave()
                assert set(numbers_of_threads()) == {1}
            assert set(numbers_of_threads()) == {1}
            others[1 - first_to_leave].leave()
            assert numbers_of_threads() == before


def test_frames_prepared_ahead_change_nothing() -> None:
    _, expected = prompt()
    tracker = Tracker(CAMERA, ConstantDepth(), CONFIG)
    given = frames(change=colour_only)
    with_features = [tracker.prepare(frame) for frame in given]
    for frame, prepared in zip(given, with_features, strict=True):
        assert tracker.step(frame, prepared).timings_ms["features"] == prepared.took_ms
    made = tracker.finish()
    np.testing.assert_array_equal(made.trajectory.T_world_camera, expected.trajectory.T_world_camera)


@pytest.mark.parametrize("late", [0, 2, 8])
def test_depth_may_be_late_by_any_number_of_frames(late: int) -> None:
    model = LateDepth(0, 0.0)
    run = Run(frames(change=colour_only), model, delayed(late))
    assert run.statuses() == {TrackingStatus.TRACKING: COUNT}
    keyframes = [r.index for r in run.results if r.is_keyframe]
    with_depth = [r.index for r in run.results if "depth" in r.timings_ms]
    adjusted = [r.index for r in run.results if "bundle" in r.timings_ms]
    assert (
        keyframes[0] == with_depth[0] == adjusted[0] == 0
    )  # nothing to track on before the first one's depth
    for keyframe, joined in zip(keyframes, with_depth, strict=False):
        # its own delay or first adjustment, and the nine stages of the keyframe before
        assert keyframe <= joined <= keyframe + max(late, 4) + 9
    for joined, sixth in zip(with_depth, keyframes[5:], strict=False):
        assert joined <= sixth  # five wait at a time
    assert len(with_depth) >= len(keyframes) - 5
    made = run.finish()
    assert len(made.keyframes) == model.calls == len(keyframes)
    assert all(k.prediction is not None for k in made.keyframes)
    assert ate_m(made.trajectory, with_scale=True) < 0.02
    R = made.trajectory.T_world_camera[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)


def test_the_network_runs_in_one_thread_that_ends_with_the_run() -> None:
    before = threading.active_count()
    model = LateDepth(0, 0.0)
    run = Run(frames(range(12), colour_only), model)
    run.finish()
    assert len(model.threads) == 1
    assert threading.current_thread().name not in model.threads
    assert threading.active_count() == before


def test_a_later_step_raises_what_the_network_refused() -> None:
    class Broken(ConstantDepth):
        def predict(self, frame: Frame) -> DepthPrediction:
            if self.calls == 1:
                raise CameraError("too small for the network")
            return super().predict(frame)

    with pytest.raises(CameraError, match="too small"):
        Run(frames(range(40), colour_only), Broken())


def test_the_last_pose_follows_its_keyframe_and_stays_a_rotation() -> None:
    """Over a hundred corrections, each from the pose before, rounding errors must not double."""
    rng = np.random.default_rng(0)
    map_, motion = Map(), MotionModel()
    keyframe = map_.add_keyframe(frames([0])[0], None, np.eye(4), np.zeros(0, np.int64))
    relative, doubled = np.eye(4), np.eye(4)
    relative[:3, 3], doubled[:3, 3] = [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]
    T = np.eye(4)
    for _ in range(100):
        map_.correct([0], T[None])
        motion.anchor(Placement(relative @ T, np.zeros(0, np.int64)), keyframe)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = so3_exp(rng.normal(size=3)), rng.normal(size=3)
        map_.correct_similarities(invert(change @ keyframe.T_camera_world)[None], np.array([2.0]))
        motion.follow_map()
        T = motion.T_camera_world
        np.testing.assert_allclose(T, doubled @ keyframe.T_camera_world, atol=1e-9)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
