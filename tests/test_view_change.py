# SPDX-License-Identifier: Apache-2.0
"""When the camera is said to take large steps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from slamdepth.geometry import se3_exp
from slamdepth.mapping.map_view import MapView
from slamdepth.tracking.view_change import ViewChange
from slamdepth.typing import Floats, Ints

IDS = np.arange(40)


@pytest.fixture
def change() -> ViewChange:
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 3), (40, 3))
    return ViewChange(cast(MapView, SimpleNamespace(landmarks=SimpleNamespace(position_w=points))))


def walk(change: ViewChange, step: list[float], frames: int, ids: Ints = IDS) -> None:
    T: Floats = np.eye(4)
    for _ in range(frames):
        now = se3_exp(np.array(step)) @ T
        change.measure(T, now, ids)
        T = np.eye(4)


TURN, FORWARD, SMALL = [0, 0, 0, 0, 0.15, 0], [0, 0, -0.4, 0, 0, 0], [0, 0, 0, 0, 0.03, 0]


@pytest.mark.parametrize("step", [TURN, FORWARD])
def test_turns_and_steps_towards_what_is_seen_are_large(change: ViewChange, step: list[float]) -> None:
    walk(change, step, 3)
    assert change.is_large


def test_a_single_jerk_is_not_a_large_step(change: ViewChange) -> None:
    walk(change, SMALL, 2)
    walk(change, TURN, 1)
    assert not change.is_large


def test_usual_steps_end_it(change: ViewChange) -> None:
    walk(change, TURN, 3)
    walk(change, [0, 0, 0, 0, 0.07, 0], 3)
    assert change.is_large  # between the two bounds nothing changes
    walk(change, SMALL, 3)
    assert not change.is_large


def test_a_frame_that_sees_nothing_says_nothing(change: ViewChange) -> None:
    walk(change, TURN, 3, np.full(40, -1))
    assert not change.is_large


def test_a_frame_found_by_a_wide_search_only_is_a_large_step(change: ViewChange) -> None:
    walk(change, SMALL, 3)
    change.found_wide()
    assert change.is_large
    walk(change, SMALL, 2)
    assert not change.is_large


@pytest.mark.parametrize("is_doubted", [True, False])
def test_depth_is_doubted_only_where_steps_are_large_and_nothing_supports_it(is_doubted: bool) -> None:
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 3), (40, 3))
    map_ = SimpleNamespace(landmarks=SimpleNamespace(position_w=points), scale_is_doubted=is_doubted)
    change = ViewChange(cast(MapView, map_))
    assert not change.doubts_depth
    walk(change, TURN, 3)
    assert change.doubts_depth == is_doubted


def test_lost_frames_are_searched_at_once_and_then_now_and_again(change: ViewChange) -> None:
    assert [change.count_lost() for _ in range(9)] == [True] * 4 + [False] * 3 + [True, False]
    change.count_placed()
    assert change.count_lost()
