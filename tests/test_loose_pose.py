# SPDX-License-Identifier: Apache-2.0
"""Poses that landmarks determine too loosely: how much, and what tracking does about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from growing_map import add_keyframe, create
from ring_world import CAMERA, CONFIG, World, true_pose, view

from slamdepth.frontend.features import Features
from slamdepth.frontend.pose import corner_deviation_px, refine_pose
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import Placement
from slamdepth.tracking.keyframe_policy import KeyframePolicy
from slamdepth.tracking.localiser import Localiser
from slamdepth.tracking.view_change import ViewChange
from slamdepth.typing import Floats


def wall(left: float, right: float, count: int = 200) -> Floats:
    """Points ``(N, 3)`` two metres ahead between two columns of the image."""
    rng = np.random.default_rng(0)
    px = rng.uniform((left, 0.0), (right, CAMERA.height), (count, 2))
    return backproject(CAMERA, px, rng.uniform(1.9, 2.1, count))


def deviation_px(points_w: Floats) -> float:
    n = len(points_w)
    px = project(CAMERA, points_w)[0]
    estimate = refine_pose(CAMERA, np.eye(4), points_w, np.tile(1e-6 * np.eye(3), (n, 1, 1)), px, np.ones(n))
    return corner_deviation_px(CAMERA, estimate.T_camera_world, points_w, estimate.information)


def test_landmarks_in_one_half_of_the_image_leave_the_other_half_loose() -> None:
    everywhere, half, strip = (deviation_px(wall(0.0, right)) for right in (640.0, 320.0, 160.0))
    assert everywhere < 0.5
    assert half > 2.0 * everywhere
    assert strip > 1.5 * half


def test_the_deviation_is_that_of_points_moved_by_the_poses_error() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    information = 1e5 * A @ A.T
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    points = backproject(CAMERA, corners, np.full(4, 2.0))
    errors = rng.multivariate_normal(np.zeros(6), np.linalg.inv(information), 4000)
    moved = np.stack([project(CAMERA, transform(se3_exp(error), points))[0] - corners for error in errors])
    largest = max(np.linalg.eigvalsh(np.cov(moved[:, k].T))[-1] for k in range(4))
    assert corner_deviation_px(CAMERA, np.eye(4), points, information) == pytest.approx(
        largest**0.5, rel=0.05
    )


def test_a_pose_that_nothing_determines_is_loose() -> None:
    assert corner_deviation_px(CAMERA, np.eye(4), wall(0.0, 640.0), np.zeros((6, 6))) == np.inf
    assert corner_deviation_px(CAMERA, np.eye(4), np.zeros((0, 3)), np.eye(6)) == np.inf


def test_a_loosely_placed_frame_becomes_a_keyframe_once_some_of_the_last_one_is_out_of_view() -> None:
    map_ = Map()
    for k in range(9):  # not the start of the map
        keyframe = add_keyframe(map_, count=300)
        if k == 8:
            create(map_, keyframe, range(300))
    policy = KeyframePolicy(CONFIG, map_, ViewChange(map_))
    seen = keyframe.landmark_ids.copy()
    whole = Placement(np.eye(4), seen)
    fewer = Placement(np.eye(4), np.where(np.arange(300) < 250, seen, -1))
    assert not policy.wants(whole)
    assert not policy.wants(replace(whole, is_loose=True))  # a keyframe here would show nothing new
    assert not policy.wants(fewer)
    assert policy.wants(replace(fewer, is_loose=True))


@pytest.mark.parametrize("is_sensor", [True, False])
def test_landmarks_of_one_predicted_depth_do_not_outvote_triangulated_ones(is_sensor: bool) -> None:
    """The newest keyframe's landmarks are all turned by a degree, as a tilted prediction would have them."""
    world = World(4, is_sensor=is_sensor)
    map_, newest = world.map, world.map.keyframes[-1]
    ids = newest.landmark_ids
    alone = ids[map_.landmarks.observations[ids] < 2]
    assert 30 < len(alone) < len(ids) - 30
    turn = (
        newest.T_world_camera @ se3_exp(np.array([0, 0, 0, 0, np.deg2rad(0.2), 0.0])) @ newest.T_camera_world
    )
    map_._own.position_w[alone] = transform(turn, map_.landmarks.position_w[alone])
    T_true = invert(true_pose(3))
    seen, px, _ = view(true_pose(3))
    features = Features(px, px, np.zeros(len(px), np.int64), np.ones(len(px)), newest.features.descriptors)
    assert len(seen) == len(ids)
    localiser = Localiser(CAMERA, CONFIG, map_)
    placement = localiser._solve(features, T_true, ids, np.arange(len(ids)))
    error = float(rotation_angle_rad((placement.T_camera_world @ true_pose(3))[:3, :3]))
    if is_sensor:
        assert error > np.deg2rad(0.03)
    else:
        assert error < np.deg2rad(0.02)
