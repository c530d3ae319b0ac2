# SPDX-License-Identifier: Apache-2.0
"""Which keyframe a frame is remembered by."""

from __future__ import annotations

import numpy as np
import pytest
from growing_map import CAMERA, add_keyframe, create

from slamdepth.frontend.features import Features
from slamdepth.geometry import se3_exp
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.frame_log import FrameLog

COUNT = 60
MOVED = se3_exp(np.array([0.3, 0.0, 0.0, 0.0, 0.1, 0.0]))


@pytest.mark.parametrize(("shared", "moves"), [(0, True), (29, True), (30, False)])
def test_a_frame_follows_the_last_keyframe_where_both_see_the_same_and_else_another(
    shared: int, moves: bool
) -> None:
    """Features without a landmark are nothing that two views have in common."""
    map_ = Map()
    earlier = add_keyframe(map_, COUNT)
    ids = create(map_, earlier, range(50))
    of_last = np.full(COUNT, -1, dtype=np.int64)
    of_last[:shared] = ids[:shared]
    add_keyframe(map_, COUNT, ids=of_last)
    log = FrameLog(CAMERA, map_)
    seen = np.full(COUNT, -1, dtype=np.int64)
    seen[:50] = ids
    px = np.zeros((COUNT, 2))
    no_levels = np.zeros(COUNT, np.int64)
    features = Features(px, px, no_levels, np.ones(COUNT), np.zeros((COUNT, 32), np.uint8))
    log.add(0.0, features, Placement(np.eye(4), seen), is_keyframe=False)
    map_.correct([0], MOVED[None])
    T_world_camera = log.trajectory().T_world_camera[0]
    expected = np.linalg.inv(MOVED) if moves else np.eye(4)
    np.testing.assert_allclose(T_world_camera, expected, atol=1e-12)
