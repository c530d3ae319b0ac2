# SPDX-License-Identifier: Apache-2.0
"""The tracker with other features than ORB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from feature_networks import write_aliked, write_lightglue
from tracking_scene import CONFIG, ConstantDepth, Run, ate_m, colour_only, covered, frames

from slamdepth.config import Config, merge
from slamdepth.errors import ConfigError
from slamdepth.frontend.features import create_extractor
from slamdepth.types import Frame, TrackingStatus

TRACKING, LOST = TrackingStatus.TRACKING, TrackingStatus.LOST


def config_of(**features: object) -> Config:
    config = Config.from_dict(merge(CONFIG.model_dump(), {"features": features}))
    try:
        create_extractor(config.features)
    except ConfigError as error:
        pytest.skip(str(error))
    return config


@pytest.mark.parametrize("name", ["sift", "brisk", "akaze"])
def test_every_frame_is_tracked_in_metres(name: str) -> None:
    run = Run(frames(range(40)), config=config_of(name=name))
    assert run.statuses() == {TRACKING: 40}
    made = run.finish()
    assert 3 <= len(made.keyframes) <= 12
    assert ate_m(made.trajectory) < 0.012


def test_sift_with_a_constant_prior_tracks_every_frame_up_to_scale() -> None:
    run = Run(frames(range(40), colour_only), ConstantDepth(), config_of(name="sift"))
    assert run.statuses() == {TRACKING: 40}
    assert ate_m(run.finish().trajectory, with_scale=True) < 0.02


def test_a_lost_camera_is_relocalised_by_visual_words_of_orb_descriptors() -> None:
    """Both lenses are covered, and then the camera is back at the fourth frame."""

    def hidden(frame: Frame) -> Frame:
        return covered(frame) if frame.index >= 30 else frame

    given = frames(range(34), hidden)
    back = frames(range(3, 6))
    moved_on = [
        Frame(34 + i, given[-1].timestamp_s + (i + 1) / 30, f.image_rgb, f.camera, f.depth_m)
        for i, f in enumerate(back)
    ]
    run = Run([*given, *moved_on], config=config_of(name="sift"))
    assert [run.status_of(i) for i in range(30, 34)] == [LOST] * 4
    assert run.status_of(34) is TrackingStatus.RELOCALISED
    assert [run.status_of(i) for i in (35, 36)] == [TRACKING] * 2
    again, before = run.results[34].T_world_camera, run.results[3].T_world_camera
    assert again is not None
    assert before is not None
    assert np.linalg.norm(again[:3, 3] - before[:3, 3]) < 0.02


@pytest.mark.parametrize("with_matcher", [False, True])
def test_a_network_s_features_are_tracked(tmp_path: Path, with_matcher: bool) -> None:
    """Its keypoints lie on a grid and know nothing of corners; the first frames are close enough."""
    files = {"weights": str(write_aliked(tmp_path / "aliked.onnx"))}
    if with_matcher:
        files["matcher"] = str(write_lightglue(tmp_path / "lightglue.onnx"))
    run = Run(frames(range(3)), config=config_of(name="aliked", **files))
    assert run.results[0].status is TRACKING
    assert run.tracker.finish().keyframes[0].keypoints_px.shape[1] == 2
