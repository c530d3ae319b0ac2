# SPDX-License-Identifier: Apache-2.0
"""Which way is down in the world, from what single images tell, and what the depth thread makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamdepth.geometry import so3_exp
from slamdepth.tracking.depth_thread import DepthThread
from slamdepth.tracking.world_gravity import WorldGravity
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

DOWN_W = np.array([0.1, 0.9, 0.3]) / np.linalg.norm([0.1, 0.9, 0.3])
CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def turns(count: int, seed: int = 0) -> np.ndarray:
    return so3_exp(np.random.default_rng(seed).normal(0, 0.4, (count, 3)))


def test_what_most_images_tell_is_known_in_any_camera() -> None:
    gravity, rng = WorldGravity(), np.random.default_rng(1)
    for k, R in enumerate(turns(8)):
        told = R.T @ DOWN_W + rng.normal(0, 0.03, 3)
        if k in (2, 5):  # mistaken by a right angle
            told = np.cross(told, [0.0, 0.0, 1.0])
        gravity.add(R, told / np.linalg.norm(told), 0.8)
    R = turns(1, seed=3)[0]
    known = gravity.in_camera(R)
    assert known is not None
    assert known @ (R.T @ DOWN_W) > np.cos(np.radians(3))
    np.testing.assert_allclose(R @ known, gravity.in_world(), atol=1e-12)


def test_nothing_is_known_before_enough_agree() -> None:
    few, apart = WorldGravity(), WorldGravity()
    for k, R in enumerate(turns(5)):
        few.add(R, R.T @ DOWN_W, 1.0)
        apart.add(R, R.T @ DOWN_W, 1.0)
        apart.add(R, R.T @ np.roll(DOWN_W, k % 2 + 1), 1.0)
    assert few.in_camera(np.eye(3)) is None
    assert apart.in_camera(np.eye(3)) is None
    assert few.in_world() is apart.in_world() is None


def test_an_unsure_image_counts_less() -> None:
    gravity = WorldGravity()
    for k, R in enumerate(turns(10)):
        gravity.add(R, R.T @ (DOWN_W if k % 2 else np.roll(DOWN_W, 1)), 1.0 if k % 2 else 0.2)
    known = gravity.in_camera(np.eye(3))
    assert known is not None
    assert known @ DOWN_W > 0.999


class Asked:
    """A model that finds gravity where it is not told, and notes what it was told."""

    name, kind, weights = "asked", DepthKind.METRIC, ()

    def __init__(self) -> None:
        self.told: list[np.ndarray | None] = []

    def predict(self, frame: Frame) -> DepthPrediction:
        self.told.append(frame.gravity)
        found = DOWN_W if frame.gravity is None else frame.gravity
        return DepthPrediction(np.ones((24, 32), np.float32), self.kind, gravity=found, gravity_share=0.9)


def frame(index: int) -> Frame:
    return Frame(index, float(index), np.zeros((24, 32, 3), np.uint8), CAMERA)


def test_the_thread_tells_later_frames_what_earlier_ones_found() -> None:
    model = Asked()
    thread = DepthThread(model)
    for k in range(12):
        one = frame(k)
        thread.ask(one, np.eye(3))
        thread.take(one)
    thread.close()
    told = [k for k, down in enumerate(model.told) if down is not None]
    assert told == [6, 7, 8, 10, 11]  # six are asked, then every fifth of all
    assert all(np.allclose(model.told[k], DOWN_W) for k in told)


def test_the_thread_says_where_down_is_in_the_world() -> None:
    thread = DepthThread(Asked())
    assert thread.down_w() is None
    for k in range(6):
        thread.ask(frame(k), np.eye(3))
    np.testing.assert_allclose(thread.down_w(), DOWN_W)  # waits for the six
    thread.close()


def test_a_frame_that_says_itself_or_has_no_pose_is_left_alone() -> None:
    model = Asked()
    thread = DepthThread(model)
    said = replace(frame(0), gravity=np.array([0.0, 0.0, 1.0]))
    thread.ask(said, np.eye(3))
    thread.take(said)
    thread.take(frame(1))
    thread.close()
    assert model.told[0] is said.gravity
    assert model.told[1] is None
