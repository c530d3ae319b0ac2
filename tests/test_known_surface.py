# SPDX-License-Identifier: Apache-2.0
"""Depth of a keyframe's features by what earlier keyframes know."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slamdepth.depth.alignment import fit_depth_field
from slamdepth.geometry import se3_exp, transform
from slamdepth.mapping.map import Map, MapKeyframe
from slamdepth.tracking.known_surface import KnownSurface
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame
from slamdepth.typing import Floats

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, distortion=(0.15, -0.2, 0.001, -0.001, 0.0))
FRAME = Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), CAMERA)
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 2.0  # of a tilted wall in the world: NORMAL . p = DISTANCE
MOTION = se3_exp(np.array([-0.15, 0.05, 0.1, 0.02, -0.05, 0.03]))


def wall_depth(px: Floats, T_camera_world: Floats) -> Floats:
    """Depth ``(N,)`` of the wall at undistorted pixels."""
    rays = np.column_stack(
        [(px[:, 0] - CAMERA.cx) / CAMERA.fx, (px[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(len(px))]
    )
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    normal_c = R @ NORMAL
    return np.asarray((DISTANCE + normal_c @ t) / (rays @ normal_c))


def image_of_depth(T_camera_world: Floats) -> DepthPrediction:
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    raw_px = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    depth = wall_depth(CAMERA.undistort_points(raw_px), T_camera_world).reshape(u.shape)
    return DepthPrediction(depth.astype(np.float32), DepthKind.METRIC, np.full(depth.shape, 0.02, np.float32))


def keyframe_at(map_: Map, T_camera_world: Floats) -> MapKeyframe:
    raw_px = np.random.default_rng(0).uniform((20, 20), (300, 220), (200, 2))
    features: Any = SimpleNamespace(raw_px=raw_px, px=CAMERA.undistort_points(raw_px))
    return map_.add_keyframe(FRAME, features, T_camera_world, np.full(200, -1, dtype=np.int64))


@pytest.fixture
def scene() -> tuple[Map, KnownSurface, MapKeyframe, MapKeyframe]:
    map_, surface = Map(), KnownSurface(CAMERA)
    first = keyframe_at(map_, np.eye(4))
    add(surface, first, image_of_depth(np.eye(4)))
    return map_, surface, first, keyframe_at(map_, MOTION)


def add(surface: KnownSurface, keyframe: MapKeyframe, prediction: DepthPrediction) -> None:
    none = np.zeros(0)
    field = fit_depth_field(np.zeros((0, 2)), none, none, none, none, width=CAMERA.width)
    surface.add(keyframe, prediction, field)


Scene = tuple[Map, KnownSurface, MapKeyframe, MapKeyframe]


def test_a_feature_is_as_far_as_an_earlier_view_says(scene: Scene) -> None:
    _, surface, first, second = scene
    log_depth, sigma = surface.log_depth(second, [first])
    known = np.isfinite(log_depth)
    assert known.mean() > 0.85  # the others are out of the first view
    truth = wall_depth(second.features.px, MOTION)
    np.testing.assert_allclose(np.exp(log_depth[known]), truth[known], rtol=0.01)
    np.testing.assert_allclose(sigma[known], 0.02, rtol=0.01)
    assert not np.isfinite(sigma[~known]).any()


def test_what_no_view_shows_is_not_known(scene: Scene) -> None:
    map_, surface, first, _ = scene
    away = keyframe_at(map_, se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])))
    assert not np.isfinite(surface.log_depth(away, [first])[0]).any()
    assert not np.isfinite(surface.log_depth(away, [])[0]).any()


def test_a_view_follows_the_scale_of_its_keyframe(scene: Scene) -> None:
    map_, surface, first, second = scene
    before, _ = surface.log_depth(second, [first])
    map_.rescale(2.0)
    after, _ = surface.log_depth(second, [first])
    np.testing.assert_allclose(after, before + np.log(2.0), atol=1e-9)


def test_what_is_remembered_is_restored(scene: Scene) -> None:
    map_, surface, first, second = scene
    again = KnownSurface(CAMERA)
    again.restore(surface.state(), map_.keyframes)
    for made, expected in zip(
        again.log_depth(second, [first]), surface.log_depth(second, [first]), strict=True
    ):
        np.testing.assert_array_equal(made, expected)


def test_no_depth_is_known_at_the_edge_of_a_nearer_surface(scene: Scene) -> None:
    map_, surface, _, _ = scene
    near = image_of_depth(np.eye(4))
    near.values[:, :160] *= 0.5
    other = keyframe_at(map_, np.eye(4))
    add(surface, other, near)
    same = keyframe_at(map_, np.eye(4))
    log_depth, _ = surface.log_depth(same, [other])
    off = np.abs(same.features.raw_px[:, 0] - 160)
    assert not np.isfinite(log_depth[off < 1]).any()
    assert np.isfinite(log_depth[off > 6]).all()


def test_landmarks_of_the_wall_lie_on_it(scene: Scene) -> None:
    _, surface, first, second = scene
    log_depth, _ = surface.log_depth(second, [first])
    px, z = second.features.px, np.exp(log_depth)
    points_c = np.column_stack([(px - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones(len(px))]) * z[:, None]
    off = transform(second.T_world_camera, points_c) @ NORMAL - DISTANCE
    assert np.nanmax(np.abs(off)) < 0.03
