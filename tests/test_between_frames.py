# SPDX-License-Identifier: Apache-2.0
"""What is done between two frames."""

from __future__ import annotations

import threading

import pytest
from tracking_scene import CAMERA, CONFIG, ConstantDepth, colour_only, frames

from slamdepth.config import Config, merge
from slamdepth.tracking import Tracker
from slamdepth.tracking.between_frames import BetweenFrames
from slamdepth.types import DepthPrediction, Frame


def test_a_task_is_begun_at_once_and_done_when_waited_for() -> None:
    between, may_go, done = BetweenFrames(), threading.Event(), []

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


def test_what_a_task_raises_is_raised_once_by_whoever_waits() -> None:
    between = BetweenFrames()
    between.begin(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        between.wait()
    between.wait()
    between.begin(lambda: None)
    between.wait()
    between.close()


class HeldBack(ConstantDepth):
    """Predicts the depth of the fifth keyframe only when it may."""

    def __init__(self) -> None:
        super().__init__()
        self.may_go = threading.Event()
        self.asked = 0

    def predict(self, frame: Frame) -> DepthPrediction:
        self.asked += 1
        if self.asked == 5:
            assert self.may_go.wait(30.0), "a step waited for it"
        return super().predict(frame)


def test_points_are_born_between_two_frames_without_another_step() -> None:
    model = HeldBack()
    # a short delay: no frame wants a third keyframe, and so the depth earlier, while two wait
    config = Config.from_dict(merge(CONFIG.model_dump(), {"tracking": {"depth_delay": 3}}))
    tracker = Tracker(CAMERA, model, config)
    due = before = after = 0
    for frame in frames(change=colour_only):
        result = tracker.step(frame)
        if result.is_keyframe and result.keyframes == 5:
            due = frame.index + config.tracking.depth_delay
        if due and frame.index == due - 1:
            before = tracker._map.size  # the step has returned although the next one needs the depth
            model.may_go.set()
            tracker.held()  # waits for what goes on
            after = tracker._map.size
    assert 0 < before < after
    assert len(tracker.finish().trajectory) > 0
