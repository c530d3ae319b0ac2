# SPDX-License-Identifier: Apache-2.0
"""Which place a lost camera is given where several look alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tracking_scene import CAMERA, Run, frames

from slamdepth.geometry import invert, se3_exp
from slamdepth.loops import look_alikes
from slamdepth.loops.look_alikes import Reach
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.relocaliser import Relocaliser

APART_M = 1.5  # of two desks


def two_places(monkeypatch: pytest.MonkeyPatch) -> tuple[Relocaliser, Any, Placement]:
    """A map in which everything is also seen :data:`APART_M` aside; a frame, and its true placement."""
    run = Run(frames(range(40)))
    relocaliser, features = run.slam._active.relocaliser, run.slam.prepare(frames([2])[0]).features
    placement = relocaliser.by_place(features)
    assert placement is not None
    assert placement.placed_by is PlacedBy.PLACE
    aside = se3_exp(np.array([APART_M, 0.0, 0.0, 0.0, 0.0, 0.0]))
    rival = replace(placement, T_camera_world=aside @ placement.T_camera_world)
    monkeypatch.setattr(look_alikes, "ALREADY_LINKED", len(features) + 1)
    monkeypatch.setattr(relocaliser, "place_view", lambda *_: rival)
    return relocaliser, features, placement


def test_a_frame_that_fits_two_places_is_put_in_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    relocaliser, features, _ = two_places(monkeypatch)
    assert relocaliser.by_place(features) is None
    assert relocaliser.by_recent(features, is_lost=True) is None


def test_a_place_out_of_reach_is_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    relocaliser, features, placement = two_places(monkeypatch)
    center_w = invert(placement.T_camera_world)[:3, 3]
    found = relocaliser.by_place(features, reach=Reach(center_w, 0.5 * APART_M))
    assert found is not None
    np.testing.assert_array_equal(found.T_camera_world, placement.T_camera_world)
    assert relocaliser.by_place(features, reach=Reach(center_w, 2.0 * APART_M)) is None


def test_a_frame_that_fits_a_place_of_another_map_is_put_in_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    """The map of one desk has nothing that looks like it; the camera can have left what it saw."""
    run = Run(frames(range(40)))
    relocaliser, features = run.slam._active.relocaliser, run.slam.prepare(frames([2])[0]).features
    assert relocaliser.by_place(features) is not None
    monkeypatch.setattr(relocaliser, "others", lambda: [run.slam._active])
    assert relocaliser.by_place(features) is None
    here = Reach(np.zeros(3), radius_m=0.3)  # the camera cannot have left it
    assert relocaliser.by_place(features, reach=here) is not None


def test_reach_does_not_count_where_the_recording_was_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """The place itself is out of reach: then so may be the other one."""
    relocaliser, features, placement = two_places(monkeypatch)
    elsewhere_w = invert(placement.T_camera_world)[:3, 3] + np.array([9.0, 0.0, 0.0])
    assert relocaliser.by_place(features, reach=Reach(elsewhere_w, 0.1)) is None


def test_reach_grows_with_the_speed_and_by_what_a_camera_can_accelerate() -> None:
    relocaliser = Run(frames(range(3))).slam._active.relocaliser
    step = se3_exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert relocaliser.reach(None, step) is None  # it never was lost
    one = relocaliser.reach(np.eye(4), step)
    assert one is not None
    assert one.radius_m == pytest.approx(0.02 + 4.9 / CAMERA.fps**2)
    relocaliser.schedule.start(np.eye(4), step)
    for _ in range(14):
        relocaliser.schedule.count_frame()
    half_a_second = relocaliser.reach(None, np.eye(4))
    assert half_a_second is not None
    assert half_a_second.radius_m == pytest.approx(15 * 0.02 + 4.9 * (15 / CAMERA.fps) ** 2)
