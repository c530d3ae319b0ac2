# SPDX-License-Identifier: Apache-2.0
"""Which of two ways to place a frame is believed: the usual one, or a search over a wide baseline."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import pytest

from slamdepth.config import Config
from slamdepth.mapping.placement import PlacedBy, Placement
from slamdepth.tracking.frame_placer import FramePlacer
from slamdepth.tracking.pose_check import Judgement, Verdict

EXPECTED = 1000
USUAL, WIDE = cast(Any, "usual features"), cast(Any, "wide features")
FRAME: Any = SimpleNamespace(index=7, timestamp_s=0.7)


def placement(inliers: int, placed_by: PlacedBy) -> Placement:
    ids = np.where(np.arange(EXPECTED) < inliers, np.arange(EXPECTED), -1)
    return Placement(np.eye(4), ids, expected_ids=np.arange(EXPECTED), placed_by=placed_by)


def placer(
    *,
    motion: int = 0,
    keyframe: int = 0,
    wide: int = 0,
    is_large: bool = False,
    verdict: Verdict = Verdict.EARNED,
) -> tuple[FramePlacer, MagicMock]:
    """A placer whose searches agree with so many landmarks; 0 where one finds nothing."""
    parts = MagicMock()
    parts.view_change.is_large = is_large
    parts.map.resolve.return_value = np.arange(3)
    parts.shutter.correct_by_motion.side_effect = lambda raw, *_: raw
    parts.shutter.correct_by_pose.return_value = None
    parts.integration.run_all.return_value = False
    parts.check.judge.return_value = Judgement(verdict)
    parts.localiser.track.return_value = placement(motion, PlacedBy.MOTION) if motion else None
    last = placement(keyframe, PlacedBy.LAST_KEYFRAME) if keyframe else None
    parts.localiser.from_keyframe.return_value = last
    parts.relocaliser.by_place.return_value = None
    parts.relocaliser.by_recent.return_value = placement(wide, PlacedBy.LAST_KEYFRAME) if wide else None
    parts.relocaliser.by_registration.return_value = None
    watch: Any = SimpleNamespace(timed=lambda _: nullcontext())
    return FramePlacer(parts, Config(), watch, lambda _: WIDE), parts


def test_a_few_landmarks_that_agree_by_chance_do_not_hide_a_large_step() -> None:
    slam, parts = placer(motion=36, wide=220)
    found = slam.place(FRAME, USUAL)
    assert found is not None
    assert found.placement.inliers == 220
    assert found.raw is WIDE
    assert parts.view_change.found_wide.called
    assert parts.check.judge.call_count == 1  # the pose that was not believed leaves no trace


def test_a_wide_search_that_explains_no_more_is_not_taken() -> None:
    slam, parts = placer(motion=36, wide=50)
    found = slam.place(FRAME, USUAL)
    assert found is not None
    assert found.placement.inliers == 36
    assert found.raw is USUAL
    assert not parts.view_change.is_large


@pytest.mark.parametrize("motion", [120, 600])
def test_a_pose_that_many_agree_with_costs_no_wide_search(motion: int) -> None:
    slam, parts = placer(motion=motion, wide=1000)
    found = slam.place(FRAME, USUAL)
    assert found is not None
    assert found.placement.inliers == motion
    assert not parts.relocaliser.by_recent.called


def test_a_frame_that_motion_does_not_lead_to_is_searched_widely() -> None:
    slam, parts = placer(keyframe=265, wide=500)
    found = slam.place(FRAME, USUAL)
    assert found is not None
    assert found.placement.inliers == 500
    assert not parts.motion.forget.called  # a large step, and no cut in the recording


def test_while_steps_are_large_every_search_is_wide_already() -> None:
    slam, parts = placer(keyframe=30, wide=500, is_large=True)
    found = slam.place(FRAME, USUAL)
    assert found is not None
    assert found.placement.inliers == 30
    assert not parts.relocaliser.by_recent.called


@pytest.mark.parametrize("motion", [0, 200])
def test_a_frame_without_a_believed_pose_is_lost(motion: int) -> None:
    slam, parts = placer(motion=motion, wide=300, verdict=Verdict.LOST)
    parts.check.lose.return_value = ()
    assert slam.place(FRAME, USUAL) is None
    assert parts.relocaliser.by_recent.called
    assert parts.motion.forget.called
