# SPDX-License-Identifier: Apache-2.0
"""Point-cloud registration in a synthetic room of exact planes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sequences import imread

from slamdepth.errors import CameraError, TrackingError
from slamdepth.frontend.registration import (
    CloudOdometry,
    CloudOdometryConfig,
    depth_to_cloud,
    register_cloud,
)
from slamdepth.geometry import backproject, invert, rotation_angle_rad, se3_exp, transform
from slamdepth.types import Camera

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
# Low and high corners in metres; the first is the room, seen from inside.
BOXES = np.array(
    [
        [[-1.2, -0.8, -1.5], [1.2, 0.8, 2.6]],
        [[-0.7, 0.2, 1.5], [-0.1, 0.8, 2.0]],
        [[0.5, -0.1, 1.8], [0.9, 0.8, 2.2]],
        [[-1.2, -0.5, 2.0], [-0.8, 0.1, 2.4]],
        [[0.1, -0.8, 2.2], [0.6, -0.4, 2.6]],
    ]
)


def render(T_world_camera: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Exact depth (H, W) float32 of the boxes, by intersection of rays with slabs."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays_c = backproject(camera, np.stack([u.ravel(), v.ravel()], axis=1).astype(float), np.ones(u.size))
    rays = rays_c @ T_world_camera[:3, :3].T
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    to_planes = (BOXES[:, None] - T_world_camera[:3, 3]) / rays[None, :, None]  # (B, N, 2, 3)
    enter = to_planes.min(axis=2).max(axis=2)
    leave = to_planes.max(axis=2).min(axis=2)
    depth = np.where((enter < leave) & (enter > 0), enter, np.inf)
    depth[0] = leave[0]
    nearest: np.ndarray = depth.min(axis=0).reshape(u.shape).astype(np.float32)
    return nearest


def cloud(T_world_camera: np.ndarray, stride: int = 1) -> np.ndarray:
    return depth_to_cloud(render(T_world_camera), CAMERA, stride=stride)


def distance(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    T = invert(T_a) @ T_b
    return float(np.linalg.norm(T[:3, 3])), float(rotation_angle_rad(T[:3, :3]))


# depth_to_cloud


def test_a_cloud_lies_on_what_was_seen() -> None:
    points = cloud(np.eye(4), stride=3)
    on_face = np.abs(points[:, None, None] - BOXES[None]).min(axis=(1, 2, 3))
    assert len(points) > 1500
    assert on_face.max() < 1e-5


def test_unknown_far_and_near_depth_is_dropped() -> None:
    depth = np.full((120, 160), 2.0, dtype=np.float32)
    depth[:30], depth[30:60], depth[60:90] = 0.0, 9.0, np.nan
    assert len(depth_to_cloud(depth, CAMERA, stride=1)) == 30 * 160
    assert len(depth_to_cloud(depth, CAMERA, stride=1, max_m=1.0)) == 0


def test_pixels_on_a_depth_edge_are_dropped() -> None:
    depth = np.full((120, 160), 1.0, dtype=np.float32)
    depth[:, 80:] = 1.5
    points = depth_to_cloud(depth, CAMERA, stride=1)
    assert len(points) == 120 * 158
    slanted = 1.0 + 0.005 * np.arange(160, dtype=np.float32) * np.ones((120, 1), dtype=np.float32)
    assert len(depth_to_cloud(slanted, CAMERA, stride=1)) == 120 * 160


def test_lens_distortion_is_undone() -> None:
    import cv2

    camera = replace(CAMERA, distortion=(0.2, -0.5, 0.002, -0.001, 0.3))
    points = depth_to_cloud(np.full((120, 160), 2.0, dtype=np.float32), camera, stride=7)
    projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
    v, u = np.mgrid[3:120:7, 3:160:7]
    np.testing.assert_allclose(projected[:, 0], np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-3)


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(CameraError, match="depth image is"):
        depth_to_cloud(np.ones((10, 10), dtype=np.float32), CAMERA)


# register_cloud


@pytest.mark.parametrize("seed", range(4))
def test_a_known_motion_is_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3_exp(rng.uniform(-1, 1, 6) * [0.08, 0.08, 0.08, 0.06, 0.06, 0.06])
    seen = cloud(np.eye(4))
    result = register_cloud(seen, transform(invert(T), seen), np.eye(4))
    moved_m, turned_rad = distance(result.T_world_camera, T)
    assert moved_m < 0.002
    assert turned_rad < 0.001
    assert result.is_trusted
    assert result.converged
    assert result.fitness > 0.99
    assert result.rmse_m < 0.01


def test_another_view_is_registered_to_the_map() -> None:
    T_guess, T = (
        se3_exp(np.array([0.02, 0.0, 0.05, 0.0, 0.05, 0.0])),
        se3_exp(np.array([0.1, -0.03, 0.12, 0.02, 0.12, -0.02])),
    )
    local_map = np.concatenate([cloud(np.eye(4)), transform(T_guess, cloud(T_guess))])
    result = register_cloud(local_map, cloud(T), T_guess)
    assert result.is_trusted
    moved_m, turned_rad = distance(result.T_world_camera, T)
    assert moved_m < 0.002
    assert turned_rad < 0.001


def plane(rng: np.random.Generator, half_m: float, count: int, noise_m: float) -> np.ndarray:
    return np.column_stack([rng.uniform(-half_m, half_m, (count, 2)), 2.0 + noise_m * rng.normal(size=count)])


@pytest.mark.parametrize("noise_m", [0.0, 0.008])
def test_a_plane_is_not_trusted(noise_m: float) -> None:
    rng = np.random.default_rng(0)
    result = register_cloud(plane(rng, 1.2, 20000, noise_m), plane(rng, 0.8, 9000, noise_m), np.eye(4))
    assert result.fitness > 0.9
    assert result.observability < 0.02
    assert not result.is_trusted


def test_a_corridor_is_not_trusted() -> None:
    """Two walls and a floor leave the way along them free."""
    rng = np.random.default_rng(1)

    def corridor(count: int, length_m: float) -> np.ndarray:
        points = rng.uniform([-1, -1, 1], [1, 1, length_m], (count, 3))
        side = rng.integers(0, 3, count)
        points[side == 0, 0], points[side == 1, 0], points[side == 2, 1] = -1.0, 1.0, 1.0
        return points

    result = register_cloud(corridor(30000, 4.0), corridor(9000, 3.5), np.eye(4))
    assert result.fitness > 0.9
    assert not result.is_trusted


def test_a_cloud_from_elsewhere_is_not_trusted() -> None:
    turned_away = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    assert not register_cloud(cloud(np.eye(4)), cloud(turned_away), np.eye(4)).is_trusted


def test_too_few_points_leave_the_guess() -> None:
    guess = se3_exp(np.full(6, 0.1))
    result = register_cloud(cloud(np.eye(4)), np.ones((10, 3)), guess)
    np.testing.assert_allclose(result.T_world_camera, guess, atol=1e-12)
    assert not result.is_trusted


def test_a_guess_with_an_inexact_rotation_is_taken() -> None:
    seen = cloud(np.eye(4))
    guess = np.eye(4)
    guess[:3, :3] *= 1.0 + 1e-6
    assert register_cloud(seen, seen, guess).is_trusted


def test_unsound_clouds_are_refused() -> None:
    good = cloud(np.eye(4))
    bad = good.copy()
    bad[3, 1] = np.nan
    with pytest.raises(TrackingError, match="cloud has points that are not finite"):
        register_cloud(good, bad, np.eye(4))
    with pytest.raises(TrackingError, match=r"local map must be \(N, 3\)"):
        register_cloud(good[:, :2], good, np.eye(4))
    with pytest.raises(TrackingError, match="guess must be a finite"):
        register_cloud(good, good, np.full((4, 4), np.nan))


# CloudOdometry


def path(frames: int) -> np.ndarray:
    """A curve of about 0.7 m, from rest to rest: KISS-ICP alone lags behind slow motion."""
    a = np.linspace(0.0, 1.0, frames)
    a = a * a * (3 - 2 * a)
    T = np.stack([0.5 * np.sin(2 * a), -0.1 * a, 0.4 * a, 0.1 * np.sin(3 * a), 0.5 * a, 0.05 * a], axis=1)
    return se3_exp(T)


@pytest.mark.parametrize("frames", [25, 60])
def test_odometry_follows_a_path_through_a_room(frames: int) -> None:
    T = path(frames)
    odometry = CloudOdometry()
    estimate = np.array([odometry.register(cloud(pose, 2), k / 30) for k, pose in enumerate(T)])
    np.testing.assert_allclose(estimate[0], T[0], atol=1e-12)
    for found, true in zip(estimate, T, strict=True):
        moved_m, turned_rad = distance(found, true)
        assert moved_m < 0.006
        assert turned_rad < 0.004
    assert len(odometry.local_map_w) > 500


def test_odometry_is_deterministic() -> None:
    clouds = [cloud(pose, 3) for pose in path(10)]
    runs = []
    for _ in range(2):
        odometry = CloudOdometry()
        runs.append([odometry.register(c, float(k)) for k, c in enumerate(clouds)])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_cloud_that_is_too_small_is_left_out() -> None:
    odometry = CloudOdometry(CloudOdometryConfig(min_points=100))
    seen = cloud(np.eye(4), 3)
    assert odometry.register(np.empty((0, 3)), 0.0) is None
    assert odometry.register(seen, 1.0) is not None
    assert odometry.register(seen[:50], 2.0) is None
    pose = odometry.register(seen, 3.0)
    assert pose is not None
    assert distance(pose, np.eye(4))[0] < 1e-3


def test_odometry_refuses_time_that_stands_still() -> None:
    odometry = CloudOdometry()
    odometry.register(cloud(np.eye(4), 3), 1.0)
    with pytest.raises(TrackingError, match="time must increase"):
        odometry.register(cloud(np.eye(4), 3), 1.0)


@pytest.mark.data
def test_a_real_cloud_finds_its_place(data_dir: Path) -> None:
    """Kitchen: frame 40 against the map of frames 10 and 30, from the pose of frame 30."""
    import cv2

    folder = data_dir / "7scenes_redkitchen_seq-01"
    camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_factor=1000.0)

    def read(k: int) -> tuple[np.ndarray, np.ndarray]:
        raw = imread(folder / f"frame-{k:06d}.depth.png", cv2.IMREAD_UNCHANGED)
        depth_m = np.where(raw == 65535, 0, raw).astype(np.float32) / 1000
        return depth_to_cloud(depth_m, camera), np.loadtxt(folder / f"frame-{k:06d}.pose.txt")

    views = {k: read(k) for k in (10, 30, 40)}
    local_map = np.concatenate([transform(views[k][1], views[k][0]) for k in (10, 30)])
    result = register_cloud(local_map, views[40][0], views[30][1])
    assert result.is_trusted
    moved_m, turned_rad = distance(result.T_world_camera, views[40][1])
    assert moved_m < 0.03
    assert turned_rad < 0.02
