# SPDX-License-Identifier: Apache-2.0
"""TSDF fusion on scenes with a formula: a floor, a ball on it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slamdepth.config import MapConfig
from slamdepth.depth.alignment import as_given
from slamdepth.errors import ConfigError
from slamdepth.geometry import invert, se3_exp
from slamdepth.mapping.fusion_depth import View, consistent_pixels, trusted_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapping.tsdf import fuse_keyframes
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, Trajectory

CAMERA = Camera(160, 120, 130.0, 132.0, 80.3, 59.1)
DISTORTED = replace(CAMERA, distortion=(-0.20, 0.05, -0.004, 0.003, 0.0))
CENTRE, RADIUS, WALL_Z = np.array([0.1, -0.05, 1.5]), 0.35, 2.0
SETTINGS = MapConfig(voxel_size_m=0.02, min_component_triangles=50)


def looking(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return se3_exp(np.array([x, y, 0.0, 0.0, yaw, 0.0]))


def ball_before_wall(camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth and a colour that is a function of the place: red grows with x, green with y."""
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = camera.undistort_points(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    ray = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
    d, o = ray @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    depth = (WALL_Z - o[2]) / d[:, 2]
    b, c = d @ (o - CENTRE), np.sum((o - CENTRE) ** 2) - RADIUS**2
    a = np.sum(d * d, axis=1)
    inside = b * b - a * c
    ball = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
    depth = np.where(inside > 0, ball, depth)
    points = o + depth[:, None] * d
    color = np.clip(np.column_stack([100 + 60 * points[:, :2], np.full(len(points), 50.0)]), 0, 255)
    shape = (camera.height, camera.width)
    return depth.reshape(shape).astype(np.float32), np.round(color).astype(np.uint8).reshape(*shape, 3)


def keyframe(
    number: int, camera: Camera, T_world_camera: np.ndarray, *, is_sensor: bool = True, factor: float = 1.0
) -> Keyframe:
    depth, image = ball_before_wall(camera, T_world_camera)
    depth = depth * np.float32(factor)
    return Keyframe(
        id=number,
        frame=StoredFrame(Frame(number, float(number), image, camera)),
        T_world_camera=T_world_camera,
        keypoints_px=np.zeros((0, 2)),
        depth_scale=1.0,
        prediction=StoredPrediction(DepthPrediction(depth, DepthKind.METRIC, is_sensor=is_sensor)),
        in_metres=as_given,
    )


def with_prediction(kf: Keyframe, **changes: Any) -> Keyframe:
    return replace(kf, prediction=StoredPrediction(replace(kf.prediction.load(), **changes)))


def with_depth(kf: Keyframe, depth_m: np.ndarray) -> Keyframe:
    return with_prediction(kf, values=depth_m)


def poses() -> list[np.ndarray]:
    return [looking(x, y, -0.15 * x) for x, y in ((0, 0), (0.3, 0.1), (-0.3, 0.1), (0.1, -0.2), (-0.2, -0.1))]


def distance_to_truth(vertices: np.ndarray) -> np.ndarray:
    to_ball = np.abs(np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS)
    distance: np.ndarray = np.minimum(to_ball, np.abs(vertices[:, 2] - WALL_Z))
    return distance


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_the_surface_lies_where_the_scene_is(camera: Camera) -> None:
    calls = []
    mesh = fuse_keyframes(
        [keyframe(k, camera, T) for k, T in enumerate(poses())], SETTINGS, lambda *a: calls.append(a)
    )
    distance = distance_to_truth(mesh.vertices_m)
    assert len(mesh.triangles) > 5000
    assert distance.max() < SETTINGS.voxel_size_m
    assert distance.mean() < 0.004
    on_ball = np.linalg.norm(mesh.vertices_m - CENTRE, axis=1) < RADIUS + 0.02
    assert on_ball.sum() > 300
    assert (~on_ball).sum() > 2000
    expected = (100 + 60 * mesh.vertices_m[:, :2]) / 255
    assert np.abs(mesh.colors[:, :2] - expected)[~on_ball].max() < 0.02
    assert calls == [(k, 5) for k in range(1, 6)]
    assert mesh.notes == ()


def test_triangles_face_the_cameras() -> None:
    mesh = fuse_keyframes([keyframe(k, CAMERA, T) for k, T in enumerate(poses())], SETTINGS)
    a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    flat = np.linalg.norm(normal, axis=1) < 1e-9
    assert np.mean(np.sum(normal * a, axis=1)[~flat] < 0) > 0.99  # towards the origin, where the cameras are


def test_ignoring_the_distortion_would_show() -> None:
    """The distorted case above proves something: taken as pinhole, colours land elsewhere."""
    taken = keyframe(0, DISTORTED, poses()[0])
    mesh = fuse_keyframes(
        [replace(taken, frame=StoredFrame(replace(taken.frame.load(), camera=CAMERA)))], SETTINGS
    )
    on_wall = mesh.vertices_m[:, 2] > WALL_Z - 0.02
    expected = (100 + 60 * mesh.vertices_m[:, :2]) / 255
    assert np.abs(mesh.colors[:, :2] - expected)[on_wall].max() > 0.04


def test_the_world_frame_is_the_keyframes() -> None:
    T_other_world = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.2]))
    moved = [replace(k, T_world_camera=T_other_world @ k.T_world_camera) for k in
             [keyframe(k, CAMERA, T) for k, T in enumerate(poses())]]  # fmt: skip
    mesh = fuse_keyframes(moved, SETTINGS)
    T = invert(T_other_world)
    assert distance_to_truth(mesh.vertices_m @ T[:3, :3].T + T[:3, 3]).max() < SETTINGS.voxel_size_m


def test_twice_the_same_is_the_same_mesh() -> None:
    keyframes = [keyframe(k, CAMERA, T, is_sensor=False) for k, T in enumerate(poses())]
    first, second = (fuse_keyframes(keyframes, SETTINGS) for _ in range(2))
    np.testing.assert_array_equal(first.vertices_m, second.vertices_m)
    np.testing.assert_array_equal(first.triangles, second.triangles)
    np.testing.assert_array_equal(first.colors, second.colors)


@pytest.mark.parametrize("factor", [0.6, 1.4])
def test_a_prediction_the_others_contradict_is_left_out(factor: float) -> None:
    good = [keyframe(k, CAMERA, T, is_sensor=False) for k, T in enumerate(poses())]
    outlier = keyframe(5, CAMERA, looking(0.15, 0.05), is_sensor=False, factor=factor)
    mesh = fuse_keyframes([*good[:3], outlier, *good[3:]], SETTINGS)
    assert len(mesh.triangles) > 5000
    assert np.mean(distance_to_truth(mesh.vertices_m) < SETTINGS.voxel_size_m) > 0.99


def test_consistent_pixels_keeps_the_majority() -> None:
    keyframes = [keyframe(k, CAMERA, T, is_sensor=False) for k, T in enumerate(poses())]
    keyframes.append(keyframe(5, CAMERA, looking(0.15, 0.05), is_sensor=False, factor=1.5))
    views = [View.of(trusted_depth(k, 4.0), CAMERA, k.T_world_camera) for k in keyframes]
    keep = consistent_pixels(views)
    assert min(mask.mean() for mask in keep[:5]) > 0.9
    known = views[5].depth_m > 0
    assert keep[5][known].mean() < 0.1


def test_flying_pixels_and_far_depth_are_dropped() -> None:
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 80:] = 3.0
    depth[:, 80] = 2.0  # a mean of the two sides, as a sensor gives at an edge
    depth[10, 10] = np.nan
    depth[20, 20] = 9.0
    trusted = trusted_depth(with_depth(keyframe(0, CAMERA, np.eye(4)), depth), 4.0)
    assert (trusted[30:, 79:82] == 0).all()
    assert trusted[10, 10] == trusted[20, 20] == 0
    assert (trusted[30:, :79] == 1).all()
    assert (trusted[30:, 82:] == 3).all()
    assert np.isnan(depth[10, 10])  # arguments stay as they are


def test_unsure_predictions_are_dropped_and_unsure_sensors_are_not() -> None:
    kf = keyframe(0, CAMERA, np.eye(4), is_sensor=False)
    sigma = np.full((120, 160), 0.1, np.float32)
    sigma[:, :30] = 0.7
    unsure = with_prediction(kf, sigma_log=sigma)
    assert (trusted_depth(unsure, 4.0)[:, :30] == 0).all()
    measured = with_prediction(unsure, is_sensor=True)
    assert (trusted_depth(measured, 4.0)[:, :30] > 0).mean() > 0.9


def test_specks_are_removed() -> None:
    kf = keyframe(0, CAMERA, np.eye(4))
    depth = kf.load_depth_m().copy()
    depth[:, 120:] = 0
    depth[50:60, 130:140] = 1.0
    with_speck = fuse_keyframes(
        [with_depth(kf, depth)], MapConfig(voxel_size_m=0.02, min_component_triangles=0)
    )
    clean = fuse_keyframes([with_depth(kf, depth)], SETTINGS)
    assert with_speck.vertices_m[:, 0].max() > 0.3
    on_speck = np.abs(with_speck.vertices_m[:, 2] - 1.0) < 0.05
    assert on_speck.any()
    assert not (np.abs(clean.vertices_m[:, 2] - 1.0) < 0.05).any()


def test_memory_is_bounded_by_larger_voxels() -> None:
    keyframes = [keyframe(k, CAMERA, T) for k, T in enumerate(poses())]
    mesh = fuse_keyframes(keyframes, SETTINGS, max_blocks=150)
    assert 0 < len(mesh.triangles) < len(fuse_keyframes(keyframes, SETTINGS).triangles)
    assert len(mesh.notes) == 1
    assert "voxels enlarged from 0.02" in mesh.notes[0]


def test_nothing_to_fuse_is_an_empty_mesh_with_a_note() -> None:
    assert fuse_keyframes([], SETTINGS).notes == ("no mesh: there are no keyframes",)
    kf = keyframe(0, CAMERA, np.eye(4))
    blank = fuse_keyframes([with_depth(kf, np.zeros_like(kf.load_depth_m()))], SETTINGS)
    assert blank.vertices_m.shape == blank.triangles.shape == blank.colors.shape == (0, 3)
    assert "no keyframe has depth" in blank.notes[0]
    too_small = fuse_keyframes([kf], MapConfig(voxel_size_m=0.1, min_component_triangles=10**6))
    assert "min_component_triangles" in too_small.notes[0]


def reconstruction() -> Reconstruction:
    keyframes = tuple(keyframe(k, CAMERA, T) for k, T in enumerate(poses()))
    return Reconstruction(Trajectory(np.arange(5.0), np.stack(poses())), keyframes, np.zeros((0, 3)))


def test_a_reconstruction_fuses_the_mesh_of_its_keyframes() -> None:
    calls = []
    mesh = reconstruction().fuse_mesh(
        SETTINGS.voxel_size_m,
        min_component_triangles=SETTINGS.min_component_triangles,
        progress=lambda *a: calls.append(a),
    )
    expected = fuse_keyframes(reconstruction().keyframes, SETTINGS)
    np.testing.assert_array_equal(mesh.vertices_m, expected.vertices_m)
    np.testing.assert_array_equal(mesh.triangles, expected.triangles)
    assert calls[-1] == (5, 5)
    near = reconstruction().fuse_mesh(max_depth_m=1.9)
    assert 0 < near.vertices_m[:, 2].max() < WALL_Z - 0.05


@pytest.mark.parametrize("wrong", [{"voxel_size_m": 0.0}, {"max_depth_m": -1.0}])
def test_fusing_with_a_setting_out_of_range_is_a_config_error(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        reconstruction().fuse_mesh(**wrong)
