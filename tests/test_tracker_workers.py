# SPDX-License-Identifier: Apache-2.0
"""The tracker's threads: tasks between two frames, and the end of every thread."""

from __future__ import annotations

import threading

import pytest
from tracking_scene import CAMERA, CONFIG, ConstantDepth, colour_only, frames

from slamdepth.config import Config, merge
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import CameraError, TrackingError
from slamdepth.tracking import CloudTracker, Tracker, create_tracker
from slamdepth.tracking.workers import BetweenFrames, Worker
from slamdepth.types import DepthPrediction, Frame


def test_a_task_starts_at_once_and_is_complete_after_the_wait() -> None:
    between, may_go = BetweenFrames(), threading.Event()
    done: list[threading.Thread] = []

    def task() -> None:
        may_go.wait(10.0)
        done.append(threading.current_thread())

    between.wait()  # nothing to wait for
    between.begin(task)
    assert not done
    may_go.set()
    between.wait()
    assert done
    assert done[0] is not threading.current_thread()
    between.wait()
    assert len(done) == 1
    between.close()


def test_what_a_task_raises_is_raised_once_by_the_wait() -> None:
    between = BetweenFrames()
    between.begin(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        between.wait()
    between.wait()
    between.begin(lambda: None)
    between.wait()
    between.close()


def test_a_closed_worker_has_finished_what_it_began_and_dropped_the_rest() -> None:
    worker, began, may_go = Worker("test"), threading.Event(), threading.Event()
    done: list[int] = []

    def first() -> None:
        began.set()
        may_go.wait(10.0)
        done.append(1)

    running = worker.submit(first)
    waiting = worker.submit(done.append, 2)
    assert began.wait(10.0)
    closing = threading.Thread(target=worker.close)
    closing.start()
    may_go.set()
    closing.join(10.0)
    assert not closing.is_alive()
    assert running.done()
    assert waiting.cancelled() is (done == [1])


class HeldBack(ConstantDepth):
    """Predicts the depth of the fifth keyframe only when it may."""

    def __init__(self) -> None:
        super().__init__()
        self.may_go = threading.Event()
        self.requests = 0

    def predict(self, frame: Frame) -> DepthPrediction:
        self.requests += 1
        if self.requests == 5:
            assert self.may_go.wait(30.0), "a step waited for it"
        return super().predict(frame)


def test_landmarks_are_created_between_two_frames_without_another_step() -> None:
    model = HeldBack()
    # long enough to adjust what earlier keyframes gave, and no frame wants another keyframe meanwhile
    config = Config.from_dict(merge(CONFIG.model_dump(), {"tracking": {"depth_delay": 6}}))
    due = before = after = 0
    with Tracker(CAMERA, model, config) as tracker:
        for frame in frames(change=colour_only):
            result = tracker.step(frame)
            if result.is_keyframe and result.keyframes == 5:
                due = frame.index + config.tracking.depth_delay
            if due and frame.index == due - 1:
                before = (
                    tracker._active.map.size
                )  # the step has returned although the next one needs the depth
                model.may_go.set()
                tracker._workers.between.wait()
                after = tracker._active.map.size
        assert 0 < before < after
        assert len(tracker.finish().trajectory) > 0


# many keyframes in few frames: the first four are integrated at once, the next between two frames
DENSE = Config.from_dict(
    merge(
        CONFIG.model_dump(),
        {"tracking": {"keyframe_overlap": 0.98, "keyframe_overlap_start": 0.98, "depth_delay": 1}},
    )
)


def running() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("slamdepth-")}


def test_the_threads_are_gone_after_the_block() -> None:
    before = running()
    with Tracker(CAMERA, ConstantDepth(), DENSE) as tracker:
        for frame in frames(range(16), colour_only):
            tracker.step(frame)
        names = {thread.name.rsplit("_", 1)[0] for thread in running() - before}
        assert names == {"slamdepth-depth", "slamdepth-side", "slamdepth-between"}
    assert running() <= before


def test_the_threads_are_gone_when_the_block_raises() -> None:
    def interrupted() -> None:
        with Tracker(CAMERA, ConstantDepth(), DENSE) as tracker:
            for frame in frames(range(16), colour_only):
                tracker.step(frame)
            assert running() - before
            raise KeyboardInterrupt

    before = running()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert running() <= before


class Failing(ConstantDepth):
    """Refuses every frame from its ``first``-th call on."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._first = first

    def predict(self, frame: Frame) -> DepthPrediction:
        if self.calls + 1 >= self._first:
            self.calls += 1
            raise CameraError("too small for the network")
        return super().predict(frame)


@pytest.mark.parametrize("first", [1, 3, 5])
def test_the_threads_are_gone_when_the_depth_model_raises(first: int) -> None:
    """At the first frame, at a keyframe that is waited for, and between two frames."""

    def run() -> None:
        with Tracker(CAMERA, Failing(first), DENSE) as tracker:
            for frame in frames(change=colour_only):
                tracker.step(frame)

    before = running()
    with pytest.raises(CameraError, match="too small"):
        run()
    assert running() <= before


def test_the_threads_are_gone_when_finishing_raises() -> None:
    """At a keyframe whose depth is still to come when the run ends."""
    before = running()
    config = Config.from_dict(merge(DENSE.model_dump(), {"tracking": {"depth_delay": 30}}))
    tracker = Tracker(CAMERA, Failing(5), config)
    for frame in frames(change=colour_only):
        if tracker.step(frame).keyframes == 5:
            break
    with pytest.raises(CameraError, match="too small"):
        tracker.finish()
    assert running() <= before


def test_a_tracker_may_be_closed_twice_and_before_its_first_frame() -> None:
    unused = Tracker(CAMERA, ConstantDepth(), CONFIG)
    unused.close()
    before = running()
    tracker = Tracker(CAMERA, ConstantDepth(), CONFIG)
    tracker.step(frames([0], colour_only)[0])
    tracker.close()
    tracker.close()
    assert running() <= before


def test_a_result_can_be_taken_inside_the_block() -> None:
    with Tracker(CAMERA, ConstantDepth(), CONFIG) as tracker:
        for frame in frames(range(3), colour_only):
            tracker.step(frame)
        assert len(tracker.finish().trajectory) == 3


@pytest.mark.parametrize("odometry", ["orb", "kiss-icp"])
def test_a_closed_tracker_takes_no_frame_and_gives_no_result(odometry: str) -> None:
    config = CONFIG.model_copy(update={"odometry": odometry})
    first, second = frames([0, 1])
    with create_tracker(CAMERA, SensorDepth(), config) as tracker:
        assert isinstance(tracker, CloudTracker if odometry == "kiss-icp" else Tracker)
        tracker.step(first)
    with pytest.raises(TrackingError, match="finished"):
        tracker.step(second)
    with pytest.raises(TrackingError, match="finished"):
        tracker.finish()


def test_an_error_between_frames_that_nobody_waited_for_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    between = BetweenFrames()

    def fail() -> None:
        raise ValueError("the map broke")

    between.begin(fail)
    between.close()
    assert "the map broke" in caplog.text
