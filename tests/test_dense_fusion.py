# SPDX-License-Identifier: Apache-2.0
"""Fusion of dense depth on walls whose places are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slamdepth.config import MapConfig
from slamdepth.geometry import se3_exp
from slamdepth.mapping.cloud import measured_cloud
from slamdepth.mapping.dense_depth import DenseDepth, store_dense_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.patches import Patches, planes
from slamdepth.mapping.signed_distance import blocks_of, union
from slamdepth.mapping.spill_file import SpillFile
from slamdepth.mapping.tsdf import fuse_keyframes
from slamdepth.open3d_loader import import_open3d
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
SHAPE = (120, 160)
VOXEL_M = 0.02
SETTINGS = MapConfig(voxel_size_m=VOXEL_M, min_component_triangles=0)
PLACES = (0.0, 0.1, -0.1, 0.2, -0.2)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    return se3_exp(np.array([x, y, z, 0.0, 0.0, 0.0]))


def wall(z_m: float = 2.0) -> NDArray[np.float32]:
    return np.full(SHAPE, z_m, np.float32)


def slanted(T_world_camera: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float32]:
    """Depth of the plane ``normal . X = 2``."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(SHAPE)], axis=2)
    return np.asarray((2.0 - normal @ T_world_camera[:3, 3]) / (rays @ normal), np.float32)


def dense(
    depth_m: NDArray[np.float32],
    sigma_log: float | NDArray[np.float32] = 0.01,
    measured: bool | NDArray[np.bool_] = True,
    color: Sequence[int] = (90, 120, 150),
) -> DenseDepth:
    return DenseDepth(
        CAMERA,
        np.broadcast_to(np.array(color, np.uint8), (*SHAPE, 3)).copy(),
        depth_m,
        np.broadcast_to(np.asarray(sigma_log, np.float32), SHAPE).copy(),
        np.broadcast_to(np.asarray(measured), SHAPE).copy(),
    )


def keyframe(
    number: int,
    T_world_camera: NDArray[np.float64],
    depth: DenseDepth | None,
    *,
    is_sensor: bool = False,
    given_m: float = 2.5,
) -> Keyframe:
    """A keyframe whose given depth is another than its dense depth."""
    prediction = DepthPrediction(wall(given_m), DepthKind.METRIC, None, is_sensor=is_sensor)
    return Keyframe(
        number,
        StoredFrame(Frame(number, float(number), np.full((*SHAPE, 3), 40, np.uint8), CAMERA)),
        T_world_camera,
        np.zeros((0, 2)),
        1.0,
        StoredPrediction(prediction),
        lambda one: one.values,
        dense=None if depth is None else store_dense_depth(depth, SpillFile()),
    )


def fused(*views: tuple[NDArray[np.float64], DenseDepth], settings: MapConfig = SETTINGS) -> Mesh:
    return fuse_keyframes([keyframe(k, T, depth) for k, (T, depth) in enumerate(views)], settings)


def inner(mesh: Mesh, edge_m: float = 0.6) -> NDArray[np.bool_]:
    """Vertices in the middle of the picture."""
    return np.asarray((np.abs(mesh.vertices_m[:, :2]) < edge_m).all(axis=1))


def test_dense_depth_replaces_the_depth_that_was_given() -> None:
    mesh = fused(*((pose(x), dense(wall())) for x in PLACES))
    assert len(mesh.triangles) > 5000
    assert np.abs(mesh.vertices_m[:, 2] - 2.0).max() < 0.002
    assert np.abs(mesh.colors - np.array([90, 120, 150]) / 255).max() < 0.02


@pytest.mark.parametrize("lateral", [0.5, 1.5])
def test_a_slanted_wall_is_a_plane_between_its_pixels(lateral: float) -> None:
    normal = np.array([lateral, 0.2, 1.0])
    mesh = fused(*((pose(x), dense(slanted(pose(x), normal))) for x in PLACES))
    off = (mesh.vertices_m @ normal - 2.0) / np.linalg.norm(normal)
    assert len(mesh.triangles) > 5000
    assert np.abs(off).mean() < 0.001
    assert np.abs(off).max() < 0.5 * VOXEL_M


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_precise_view_wins(order: tuple[int, int]) -> None:
    views = [(pose(), dense(wall(2.0), 0.01)), (pose(0.1), dense(wall(2.04), 0.05))]
    mesh = fused(*(views[k] for k in order))
    assert np.abs(mesh.vertices_m[inner(mesh), 2] - 2.0).max() < 0.006


def test_equally_sure_views_meet_in_the_middle() -> None:
    mesh = fused((pose(), dense(wall(1.98))), (pose(), dense(wall(2.02))))
    assert np.abs(mesh.vertices_m[inner(mesh), 2] - 2.0).max() < 0.004


def test_a_measured_surface_does_not_move_for_completed_ones() -> None:
    guesses = [(pose(x), dense(wall(1.95), 0.05, False)) for x in PLACES]
    mesh = fused((pose(), dense(wall(2.0), 0.02)), *guesses)
    assert np.abs(mesh.vertices_m[inner(mesh), 2] - 2.0).max() < 0.01


def test_completed_pixels_fill_what_nothing_measured() -> None:
    measured = np.zeros(SHAPE, bool)
    measured[:, :80] = True
    mesh = fused(*((pose(x), dense(wall(), 0.05, measured)) for x in PLACES))
    right = mesh.vertices_m[mesh.vertices_m[:, 0] > 0.4]
    assert len(right) > 500
    assert np.abs(right[:, 2] - 2.0).max() < 0.002


def test_a_floating_piece_is_carved_by_the_views_that_see_through_it() -> None:
    floating = wall()
    floating[40:80, 60:100] = 1.2
    alone = fused((pose(), dense(floating, 0.02)))
    assert (np.abs(alone.vertices_m[:, 2] - 1.2) < 0.05).sum() > 200
    mesh = fused((pose(), dense(floating, 0.02)), *((pose(x), dense(wall(), 0.02)) for x in PLACES[1:]))
    assert mesh.vertices_m[:, 2].min() > 1.9


def test_a_sure_view_is_not_carved_by_unsure_ones() -> None:
    floating = wall()
    floating[40:80, 60:100] = 1.2
    unsure = [(pose(x), dense(wall(), 0.09, False)) for x in PLACES[1:]]
    mesh = fused((pose(), dense(floating, 0.01)), *unsure)
    assert (np.abs(mesh.vertices_m[:, 2] - 1.2) < 0.02).sum() > 200


def test_an_edge_of_depth_is_not_bridged() -> None:
    step = wall()
    step[:, :80] = 1.5
    mesh = fused(*((pose(0.001 * k), dense(step)) for k in range(5)))
    z = mesh.vertices_m[:, 2]
    assert (np.abs(z - 1.5) < 0.002).sum() > 1000
    assert (np.abs(z - 2.0) < 0.002).sum() > 1000
    assert ((z > 1.5 + VOXEL_M) & (z < 2.0 - VOXEL_M)).sum() == 0


def test_an_edge_that_is_smeared_over_some_pixels_is_not_bridged() -> None:
    step = wall()
    step[:, :76] = 1.5
    step[:, 76:84] = np.linspace(1.5, 2.0, 8)
    mesh = fused(*((pose(0.001 * k), dense(step)) for k in range(5)))
    z = mesh.vertices_m[:, 2]
    assert ((z > 1.6) & (z < 1.9)).sum() == 0
    assert (z > 1.99).sum() > 1000


def test_unsure_and_far_pixels_are_left_out() -> None:
    depth = wall()
    depth[:10] = 5.0
    depth[0, 0] = np.nan
    sigma = np.full(SHAPE, 0.01, np.float32)
    sigma[20:30] = 0.2
    view = Patches.of(dense(depth, sigma), np.eye(4), VOXEL_M, 4.0)
    assert not view.depth_m[:10].any()
    assert not view.depth_m[20:30].any()
    assert (view.depth_m[40:] == 2.0).all()
    assert np.isnan(depth[0, 0])  # arguments stay as they are


def test_the_weight_follows_the_deviation() -> None:
    sigma = np.full(SHAPE, 0.01, np.float32)
    sigma[60:] = 0.05
    view = Patches.of(dense(wall(), sigma), np.eye(4), VOXEL_M, 4.0)
    sure, unsure = view.weight[59, 80], view.weight[60, 80]
    assert sure == pytest.approx(1.0 / (1.0 + 1.0), rel=1e-3)  # a deviation of a voxel
    assert unsure == pytest.approx(1.0 / (25.0 + 1.0), rel=1e-2)
    guess = Patches.of(dense(wall(), sigma, False), np.eye(4), VOXEL_M, 4.0)
    np.testing.assert_allclose(guess.weight, 0.01 * view.weight, rtol=1e-5)


def test_planes_are_exact_on_a_plane_and_stop_at_edges() -> None:
    normal = np.array([0.6, -0.3, 1.0])
    depth = slanted(np.eye(4), normal)
    found, cosine = planes(depth, CAMERA)
    unit = normal / np.linalg.norm(normal)
    assert np.abs(found - unit).max() < 1e-3
    assert cosine[59, 79] == pytest.approx(unit[2], abs=0.01)
    depth[:, 80:] *= 1.5
    depth[:, :20] = 0.0
    found, _ = planes(depth, CAMERA)
    known = depth > 0
    assert np.abs(found[:, :80][known[:, :80]] - unit).max() < 0.02
    assert np.isfinite(found).all()


def test_colours_come_from_the_close_and_sharp_view() -> None:
    far = [(pose(0, 0, -1.0), dense(wall(3.0), 0.01, True, (0, 0, 250))) for _ in range(2)]
    near = (pose(0, 0, 0.8), dense(wall(1.2), 0.01, True, (250, 0, 0)))
    mesh = fused(*far, near)
    center = inner(mesh, 0.3)
    assert mesh.colors[center, 0].min() > 0.7
    rng = np.random.default_rng(0)
    speckled = rng.integers(100, 156, (*SHAPE, 1)).astype(np.uint8) * np.array([1, 0, 0], np.uint8)
    sharp = DenseDepth(CAMERA, speckled, wall(), np.full(SHAPE, 0.01, np.float32), np.ones(SHAPE, bool))
    mesh = fused((pose(), sharp), (pose(), dense(wall(), color=(0, 0, 128))))
    assert mesh.colors[inner(mesh), 2].mean() < 0.1


def test_twice_the_same_is_the_same_mesh_and_the_same_cloud(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    depths = [
        dense(wall() * np.exp(rng.normal(0, 0.01, SHAPE)).astype(np.float32), 0.02, rng.random(SHAPE) < 0.7)
        for _ in PLACES
    ]
    keyframes = [keyframe(k, pose(x), depth) for k, (x, depth) in enumerate(zip(PLACES, depths, strict=True))]
    for name in ("a", "b"):
        fuse_keyframes(keyframes, SETTINGS).save(tmp_path / f"mesh-{name}.ply")
        measured_cloud(keyframes, 0.01, 4.0).save(tmp_path / f"cloud-{name}.ply")
    for kind in ("mesh", "cloud"):
        assert (tmp_path / f"{kind}-a.ply").read_bytes() == (tmp_path / f"{kind}-b.ply").read_bytes()


def test_memory_is_bounded_by_larger_voxels_here_too() -> None:
    keyframes = [keyframe(k, pose(x), dense(wall())) for k, x in enumerate(PLACES)]
    mesh = fuse_keyframes(keyframes, SETTINGS, max_blocks=120)
    assert 0 < len(mesh.triangles) < len(fuse_keyframes(keyframes, SETTINGS).triangles)
    assert "voxels enlarged from 0.02" in mesh.notes[0]


def test_no_depth_is_an_empty_mesh_with_a_note() -> None:
    mesh = fused((pose(), dense(np.zeros(SHAPE, np.float32))))
    assert "no keyframe has depth" in mesh.notes[0]


def test_a_turned_camera_sees_the_same_world() -> None:
    T_other_world = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.2]))
    there = fused(*((T_other_world @ pose(x), dense(wall())) for x in PLACES))
    back = (there.vertices_m - T_other_world[:3, 3]) @ T_other_world[:3, :3]
    assert np.abs(back[:, 2] - 2.0).max() < 0.003
    assert len(there.triangles) > 5000


def test_blocks_hold_the_surface_and_come_once() -> None:
    view = Patches.of(dense(wall()), np.eye(4), VOXEL_M, 4.0)
    blocks = blocks_of(view, VOXEL_M)
    assert len(np.unique(blocks, axis=0)) == len(blocks)
    assert set(blocks[:, 2]) == {12}  # 1.92 to 2.08 m
    np.testing.assert_array_equal(union([blocks, blocks[::-1]]), blocks)
    assert union([]).shape == (0, 3)


def test_a_mesh_file_has_normals_that_face_the_camera(tmp_path: Path) -> None:
    mesh = fused(*((pose(x), dense(wall())) for x in PLACES))
    mesh.save(tmp_path / "mesh.ply")
    read = import_open3d().io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert read.has_vertex_normals()
    assert read.has_vertex_colors()
    normals = np.asarray(read.vertex_normals)
    assert np.mean(normals[:, 2] < -0.99) > 0.99


def test_a_cloud_has_one_point_for_each_voxel_of_what_was_measured(tmp_path: Path) -> None:
    measured = np.zeros(SHAPE, bool)
    measured[:, :80] = True
    keyframes = [keyframe(k, pose(), dense(wall(), 0.02, measured)) for k in range(3)]
    cloud = measured_cloud(keyframes, 0.05, 4.0)
    assert len(np.unique(np.floor(cloud.points_m / 0.05), axis=0)) == len(cloud) > 100
    assert np.abs(cloud.points_m[:, 2] - 2.0).max() < 0.002
    assert cloud.points_m[:, 0].max() < 0.01
    assert np.abs(cloud.normals - [0, 0, -1]).max() < 0.01
    assert np.abs(cloud.colors.astype(int) - [90, 120, 150]).max() <= 3
    cloud.save(tmp_path / "cloud.ply")
    read = import_open3d().io.read_point_cloud(str(tmp_path / "cloud.ply"))
    np.testing.assert_allclose(np.asarray(read.points), cloud.points_m)
    np.testing.assert_allclose(np.asarray(read.normals), cloud.normals)


def test_a_cloud_is_of_a_sensor_but_not_of_a_network_alone() -> None:
    sensor = measured_cloud([keyframe(0, pose(), None, is_sensor=True)], 0.05, 4.0)
    assert np.abs(sensor.points_m[:, 2] - 2.5).max() < 0.002
    assert np.abs(sensor.colors.astype(int) - 40).max() <= 1
    assert len(measured_cloud([keyframe(0, pose(), None)], 0.05, 4.0)) == 0
    assert len(measured_cloud([], 0.05, 4.0)) == 0


def test_a_cloud_of_too_many_points_gets_larger_voxels_and_a_note() -> None:
    keyframes = [keyframe(k, pose(), dense(wall())) for k in range(3)]
    cloud = measured_cloud(keyframes, 0.02, 4.0, max_points=2000)
    assert 500 < len(cloud) <= 2000
    assert "voxels enlarged from 0.02" in cloud.notes[0]
