# SPDX-License-Identifier: Apache-2.0
"""The surface that a depth sensor saw, and where it can judge others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import copy_of
from surfaces import wall

from slamdepth.datasets import open_dataset
from slamdepth.errors import DatasetError
from slamdepth.evaluation.pose_alignment import align_by_poses, poses_at
from slamdepth.geometry import rotation_angle_rad, se3_exp
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.sensor_surface import SensorFrame, SensorSurface, fuse_sensor
from slamdepth.pipeline.surface import score_mesh, sensor_reference
from slamdepth.types import Camera, Trajectory

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


def seen_wall(depth_m: float = 2.0, max_depth_m: float = 4.0) -> SensorSurface:
    """A wall seen by two cameras 20 cm apart; the left third of each image is unknown."""
    depth = np.full((120, 160), depth_m, np.float32)
    depth[:, :53] = 0.0
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.2
    frames = [SensorFrame(depth, CAMERA, pose) for pose in poses]
    return fuse_sensor(frames, voxel_m=0.02, max_depth_m=max_depth_m, behind_m=0.5)


def test_a_wall_is_where_the_sensor_saw_it() -> None:
    surface = seen_wall()
    assert len(surface.triangles) > 100
    np.testing.assert_allclose(surface.vertices_m[:, 2], 2.0, atol=2e-3)
    again = seen_wall()
    np.testing.assert_array_equal(surface.vertices_m, again.vertices_m)
    np.testing.assert_array_equal(surface.triangles, again.triangles)


@pytest.mark.parametrize(
    ("point", "is_judged", "why"),
    [
        ((0.3, 0.0, 2.0), True, "on the wall"),
        ((0.3, 0.0, 1.0), True, "floating in space that was seen to be empty"),
        ((0.3, 0.0, 2.4), True, "a wall that is too far away"),
        ((0.3, 0.0, 2.6), False, "hidden behind the wall"),
        ((-0.9, 0.0, 2.0), False, "in pixels without depth"),
        ((5.0, 0.0, 2.0), False, "outside of every view"),
        ((0.3, 0.0, -1.0), False, "behind the cameras"),
    ],
)
def test_what_can_be_judged(point: tuple[float, float, float], is_judged: bool, why: str) -> None:
    assert seen_wall().can_judge(np.array([point]))[0] == is_judged, why


def test_depth_beyond_the_range_is_unknown() -> None:
    surface = seen_wall(3.0, max_depth_m=2.5)
    assert len(surface.triangles) == 0
    assert not surface.can_judge(np.array([[0.3, 0.0, 1.0]])).any()


def test_poses_are_interpolated_between_the_two_around_a_time() -> None:
    turn = np.array([0.1, 0.0, 0.2, 0.0, 0.4, 0.0])
    path = Trajectory(np.array([0.0, 0.01, 1.0]), np.stack([np.eye(4), se3_exp(turn), np.eye(4)]))
    rows, poses = poses_at(path, np.array([-0.5, 0.005, 0.01, 0.5, 1.01]), 0.02)
    assert rows.tolist() == [1, 2, 4]
    np.testing.assert_allclose(poses[0], se3_exp(turn / 2), atol=1e-9)
    np.testing.assert_allclose(poses[1], se3_exp(turn), atol=1e-9)
    np.testing.assert_allclose(poses[2], np.eye(4), atol=1e-9)


def moved_path(noise_m: float) -> tuple[Trajectory, Trajectory, np.ndarray]:
    """A short path, the same in another frame with positions that err, and the true similarity."""
    rng = np.random.default_rng(0)
    tangents = 0.1 * rng.normal(size=(50, 6))
    true = se3_exp(tangents)
    T = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 0.4]))
    estimate = np.linalg.inv(T) @ true
    estimate[:, :3, 3] = estimate[:, :3, 3] / 1.25 + noise_m * rng.normal(size=(50, 3))
    times_s = np.arange(50) / 30
    T[:3, :3] *= 1.25
    return Trajectory(times_s, true), Trajectory(times_s, estimate), T


def test_poses_align_exactly_where_they_are_exact() -> None:
    true, estimate, T_truth_estimate = moved_path(0.0)
    found = align_by_poses(true, estimate, 0.02)
    np.testing.assert_allclose(found.sim3, T_truth_estimate, atol=1e-3)
    assert found.scale == pytest.approx(1.25, abs=1e-3)
    np.testing.assert_allclose(found.se3[:3, :3] * found.scale, found.sim3[:3, :3], atol=1e-6)


def test_orientations_settle_the_rotation_where_positions_err() -> None:
    """Positions that err by 5 cm over a path of 30 cm."""
    true, estimate, T_truth_estimate = moved_path(0.05)
    found = align_by_poses(true, estimate, 0.02)
    R = found.se3[:3, :3].T @ T_truth_estimate[:3, :3] / 1.25
    assert np.degrees(rotation_angle_rad(R)) < 0.1


def test_poses_that_cannot_be_aligned_are_an_error() -> None:
    true, estimate, _ = moved_path(0.0)
    with pytest.raises(DatasetError, match="only 0 poses"):
        align_by_poses(true, Trajectory(estimate.timestamps_s + 100, estimate.T_world_camera), 0.02)
    still = Trajectory(true.timestamps_s, np.tile(np.eye(4), (50, 1, 1)))
    with pytest.raises(DatasetError, match="stands still"):
        align_by_poses(true, still, 0.02)


def test_the_reference_of_a_rendered_room_scores_itself_as_exact(tiny_room: Path) -> None:
    room = open_dataset(tiny_room)
    assert room.ground_truth is not None
    seen = sensor_reference(room, frames=20)
    mesh = Mesh(seen.vertices_m, seen.triangles, np.zeros_like(seen.vertices_m))
    scores, errors_m, notes = score_mesh(room, range(len(room)), mesh, room.ground_truth)
    assert scores is not None
    assert errors_m is not None
    assert notes == ()
    assert scores.se3.within[0.02].f_score > 0.97
    assert scores.se3.judged > 0.99
    assert errors_m.shape == (len(mesh.vertices_m),)
    assert np.nanmedian(errors_m) < 0.005


def test_a_sequence_without_depth_or_truth_is_no_reference(tiny_room: Path, tmp_path: Path) -> None:
    for name, message in (("depth.txt", "no sensor depth"), ("groundtruth.txt", "no ground truth")):
        folder = copy_of(tiny_room, tmp_path / name)
        (folder / name).unlink()
        with pytest.raises(DatasetError, match=message):
            sensor_reference(open_dataset(folder))


def test_trouble_with_the_reference_becomes_a_note(tiny_room: Path) -> None:
    room = open_dataset(tiny_room)
    assert room.ground_truth is not None
    far = wall(500.0)
    mesh = Mesh(far.vertices_m, far.triangles.astype(np.int32), np.zeros_like(far.vertices_m))
    scores, errors_m, notes = score_mesh(room, range(5), mesh, room.ground_truth)
    assert (scores, errors_m) == (None, None)
    assert "the mesh is not scored" in notes[0]
    assert score_mesh(room, range(5), None, room.ground_truth) == (None, None, ())


def test_depth_that_the_surface_does_not_confirm_judges_nothing() -> None:
    """One of twelve frames sees a box that is gone in the others: too few for a surface."""
    wall_m = np.full((120, 160), 2.0, np.float32)
    box_m = wall_m.copy()
    box_m[40:80, 60:100] = 1.0
    frames = [SensorFrame(wall_m, CAMERA, np.eye(4))] * 11 + [SensorFrame(box_m, CAMERA, np.eye(4))]
    seen = fuse_sensor(frames, 0.02, 4.0, behind_m=0.5)
    assert (seen.views[-1].depth_m[45:75, 65:95] == 0.0).all()
    assert (seen.views[0].depth_m[5:115, 5:155] > 0.0).all()
