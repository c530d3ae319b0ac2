# SPDX-License-Identifier: Apache-2.0
"""Things that move by themselves are noticed, and nothing static is taken for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_up_runs import COUNT, facts, kinds
from tracking_scene import CAMERA, Run, frames, played

from slamdepth.evaluation import Health, SpanKind, Verdict, judge_run
from slamdepth.frontend.features import Features
from slamdepth.frontend.moving import moving_share
from slamdepth.geometry import backproject, project, se3_exp, transform
from slamdepth.types import Frame
from slamdepth.typing import Floats

PATCH_PX = 110


def with_poster(frame: Frame, n: int) -> Frame:
    """A poster is carried through the image, two pixels a frame."""
    rng = np.random.default_rng(0)
    squares = rng.integers(0, 255, (PATCH_PX // 5, PATCH_PX // 5, 3), dtype=np.uint8)
    image = frame.image_rgb.copy()
    left, top = 40 + 2 * n, 30 + n
    image[top : top + PATCH_PX, left : left + PATCH_PX] = squares.repeat(5, axis=0).repeat(5, axis=1)
    return replace(frame, image_rgb=image)


def shares(run: Run) -> list[float]:
    return [result.moving_share for result in run.results if result.moving_share is not None]


def test_nothing_moves_in_a_room_that_a_camera_walks_through() -> None:
    still = shares(Run(frames(range(40))))
    assert len(still) > 20
    assert max(still) < 0.05


def test_a_poster_that_is_carried_past_a_camera_at_rest_moves() -> None:
    moving = shares(Run(played(with_poster(frames([0])[0], n) for n in range(40))))
    assert len(moving) > 20
    assert min(moving[-15:]) > 0.08  # once the map has settled


def test_what_was_seen_before_follows_new_landmark_ids() -> None:
    """A map gives ids away by themselves only after minutes."""
    run = Run(frames(range(30)))
    tracked = run.slam._active
    run.slam._workers.between.wait()
    tracked.integration.run_all()
    ids_now = np.append(np.arange(tracked.map.size)[::-1], -1)
    last = tracked.check.moving._last
    assert last is not None
    tracked.check.moving.renumber(ids_now)
    now = tracked.check.moving._last
    assert now is not None
    seen = last[3] >= 0
    np.testing.assert_array_equal(now[3] + last[3], np.where(seen, tracked.map.size - 1, -2))


def features(px: Floats) -> Features:
    """Features whose descriptors tell them apart."""
    count = len(px)
    descriptors = np.random.default_rng(1).integers(0, 255, (count, 32), dtype=np.uint8)
    return Features(px, px, np.zeros(count, np.int64), np.ones(count), descriptors)


def share(px_before: Floats, px_now: Floats, T_now_before: Floats | None = None) -> float | None:
    every = np.arange(len(px_before))
    none = np.zeros((0, 2))
    T = np.eye(4) if T_now_before is None else T_now_before
    return moving_share(CAMERA, features(px_before), features(px_now), every, every, none, T, 2.0)


@pytest.fixture
def px() -> Floats:
    return np.random.default_rng(0).uniform([5.0, 5.0], [315.0, 235.0], (600, 2))


def test_features_that_move_together_count_and_those_that_move_apart_do_not(px: Floats) -> None:
    assert share(px, px) == 0.0
    is_inside = np.all(np.abs(px - [160.0, 120.0]) < 60.0, axis=1)
    assert share(px, px + np.where(is_inside[:, None], [8.0, 4.0], 0.0)) == pytest.approx(
        is_inside.mean(), abs=0.05
    )
    angle = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, len(px))
    apart = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert share(px, px + np.where(is_inside[:, None], apart, 0.0)) == pytest.approx(0.0, abs=0.02)


def test_points_at_any_depth_are_static_while_the_camera_moves(px: Floats) -> None:
    """Parallax is no motion, though neighbours have it in common."""
    T = se3_exp(np.array([0.02, 0.01, 0.03, 0.005, -0.01, 0.004]))
    depth = np.where(px[:, 0] < 160.0, 0.6, 5.0)
    now, _ = project(CAMERA, transform(T, backproject(CAMERA, px, depth)))
    assert share(px, now, T) == 0.0


def test_few_features_say_nothing(px: Floats) -> None:
    assert share(px[:40], px[:40]) is None


def with_moving(frames_: int, moving: float) -> Health:
    run = facts()
    steps = [
        replace(step, moving_share=moving if 50 <= n < 50 + frames_ else 0.0)
        for n, step in enumerate(run.steps)
    ]
    assert len(steps) == COUNT
    return judge_run(replace(run, steps=steps))


def test_moving_things_are_stated_and_a_doubt_only_where_most_moves() -> None:
    assert kinds(with_moving(15, 0.3)) == []
    assert kinds(with_moving(45, 0.04)) == []
    health = with_moving(45, 0.3)
    assert health.verdict is Verdict.GOOD
    assert kinds(health) == [SpanKind.MOVING]
    assert health.numbers.moving_share == 0.3
    assert health.reasons[0].startswith("Up to 30 % of what is seen moves by itself: 1.7-3.2 s.")
    assert with_moving(45, 0.7).verdict is Verdict.DOUBTFUL
