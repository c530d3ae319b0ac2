# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity that several images agree on, and how the depth worker passes it on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from slamdepth.depth.gravity_consensus import GravityConsensus
from slamdepth.geometry import so3_exp
from slamdepth.stopwatch import Stopwatch
from slamdepth.tracking.workers import DepthWorker, GravityInMap
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, WeightsInfo
from slamdepth.typing import Floats

GRAVITY_W = np.array([0.1, 0.9, 0.3]) / np.linalg.norm([0.1, 0.9, 0.3])
CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def rotations(count: int, seed: int = 0) -> Floats:
    return so3_exp(np.random.default_rng(seed).normal(0, 0.4, (count, 3)))


def test_what_most_images_agree_on_is_known_in_any_camera() -> None:
    consensus, rng = GravityConsensus(), np.random.default_rng(1)
    for k, R in enumerate(rotations(8)):
        estimate = R.T @ GRAVITY_W + rng.normal(0, 0.03, 3)
        if k in (2, 5):  # wrong by a right angle
            estimate = np.cross(estimate, [0.0, 0.0, 1.0])
        consensus.add(R, estimate / np.linalg.norm(estimate), 0.8)
    R = rotations(1, seed=3)[0]
    known, _ = consensus.in_camera(R)
    assert known is not None
    assert known @ (R.T @ GRAVITY_W) > np.cos(np.radians(3))
    in_world = consensus.in_world()
    assert in_world is not None
    np.testing.assert_allclose(R @ known, in_world, atol=1e-12)


def test_nothing_is_known_before_enough_images_agree() -> None:
    few, apart = GravityConsensus(), GravityConsensus()
    for k, R in enumerate(rotations(5)):
        few.add(R, R.T @ GRAVITY_W, 1.0)
        apart.add(R, R.T @ GRAVITY_W, 1.0)
        apart.add(R, R.T @ np.roll(GRAVITY_W, k % 2 + 1), 1.0)
    guess, is_asked = few.in_camera(np.eye(3))
    assert guess is not None
    assert is_asked
    assert apart.in_camera(np.eye(3)) == (None, True)
    assert few.in_world() is apart.in_world() is None


def test_enough_images_that_do_not_agree_are_told_from_too_few() -> None:
    consensus = GravityConsensus()
    for k, R in enumerate(rotations(6)):
        assert not consensus.disagrees
        consensus.add(R, R.T @ np.roll(GRAVITY_W, k % 2), 1.0)
    assert consensus.disagrees
    for R in rotations(9, seed=1):
        consensus.add(R, R.T @ GRAVITY_W, 1.0)
    assert not consensus.disagrees


def test_an_estimate_of_low_confidence_counts_less() -> None:
    consensus = GravityConsensus()
    for k, R in enumerate(rotations(10)):
        consensus.add(R, R.T @ (GRAVITY_W if k % 2 else np.roll(GRAVITY_W, 1)), 1.0 if k % 2 else 0.2)
    known, _ = consensus.in_camera(np.eye(3))
    assert known is not None
    assert known @ GRAVITY_W > 0.999


class GravityModel:
    """A depth model that estimates gravity where it is not given, and records what it was given."""

    name = "gravity"
    kind = DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self) -> None:
        self.given: list[Floats | None] = []
        self.is_asked: list[bool] = []

    def predict(self, frame: Frame) -> DepthPrediction:
        self.given.append(frame.gravity)
        self.is_asked.append(frame.gravity_is_guess)
        gravity = GRAVITY_W if frame.gravity is None else frame.gravity
        return DepthPrediction(np.ones((24, 32), np.float32), self.kind, gravity=gravity, gravity_share=0.9)


@contextmanager
def worker_of(model: GravityModel) -> Iterator[DepthWorker]:
    worker = DepthWorker(model, Stopwatch())
    try:
        yield worker
    finally:
        worker.close()


def frame(index: int, camera: Camera = CAMERA) -> Frame:
    return Frame(index, float(index), np.zeros((camera.height, camera.width, 3), np.uint8), camera)


def test_later_frames_are_given_what_earlier_ones_agreed_on() -> None:
    model, known = GravityModel(), GravityInMap(GravityConsensus(), np.eye(3))
    with worker_of(model) as worker:
        for k in range(12):
            one = frame(k)
            worker.request(one, known)
            worker.take(one)
    given = {k: gravity for k, gravity in enumerate(model.given) if gravity is not None}
    assert list(given) == list(range(2, 12))  # after two as a guess
    asked = [k for k, is_asked in enumerate(model.is_asked) if is_asked]
    assert asked == [*range(6), 9]  # six, then every fifth
    assert all(np.allclose(gravity, GRAVITY_W) for gravity in given.values())


def test_each_of_the_first_portrait_frames_is_asked_by_itself() -> None:
    model, known = GravityModel(), GravityInMap(GravityConsensus(), np.eye(3))
    with worker_of(model) as worker:
        for k in range(12):
            one = frame(k, Camera(24, 32, 30.0, 30.0, 11.5, 15.5))
            worker.request(one, known)
            worker.take(one)
    assert [k for k, gravity in enumerate(model.given) if gravity is None] == list(range(6))
    assert [k for k, is_asked in enumerate(model.is_asked) if is_asked] == [*range(6), 9]


def test_images_of_two_maps_do_not_tell_one_another() -> None:
    model = GravityModel()
    maps = [GravityInMap(GravityConsensus(), np.eye(3)) for _ in range(2)]
    with worker_of(model) as worker:
        for k in range(12):
            one = frame(k)
            worker.request(one, maps[k % 2])
            worker.take(one)
    assert [k for k, gravity in enumerate(model.given) if gravity is None] == [0, 1, 2, 3]  # two of each map
    for known in maps:
        gravity_w = known.consensus.in_world()
        assert gravity_w is not None
        np.testing.assert_allclose(gravity_w, GRAVITY_W)


def test_a_consensus_follows_a_turned_world_and_takes_over_another() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    first, second = GravityConsensus(), GravityConsensus()
    for consensus in (first, second):
        for _ in range(3):
            consensus.add(np.eye(3), GRAVITY_W, 1.0)
    first.turn(turn)
    second.turn(turn)
    first.absorb(second)  # three and three are enough
    gravity_w = first.in_world()
    assert gravity_w is not None
    np.testing.assert_allclose(gravity_w, turn @ GRAVITY_W)


def test_a_frame_with_its_own_gravity_or_without_a_pose_is_predicted_as_it_is() -> None:
    model = GravityModel()
    measured = replace(frame(0), gravity=np.array([0.0, 0.0, 1.0]))
    with worker_of(model) as worker:
        worker.request(measured, GravityInMap(GravityConsensus(), np.eye(3)))
        worker.take(measured)
        worker.take(frame(1))
    assert model.given[0] is measured.gravity
    assert model.given[1] is None
