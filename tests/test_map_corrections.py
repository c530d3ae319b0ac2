# SPDX-License-Identifier: Apache-2.0
"""Corrections of the map: what moves with a keyframe, and by which factor its metres change."""

from __future__ import annotations

import numpy as np
import pytest
from growing_map import add_keyframe, check, create, flat_depth, ids_of, see

from slamdepth.backend.pose_graph import Edge
from slamdepth.geometry import Similarity, invert, se3_exp, transform
from slamdepth.loops.edges import MeasuredLoop
from slamdepth.mapping.map import AdjustedLandmarks, Map
from slamdepth.mapping.map_keyframe import AnchoredPose
from slamdepth.typing import Floats

QUARTER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""A quarter turn about y: the camera's z axis becomes the world's x axis."""
COVARIANCE = np.stack([np.diag([1.0, 2.0, 3.0])] * 2)


def pose(x: float, y: float, z: float, R: Floats | None = None) -> Floats:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    if R is not None:
        T[:3, :3] = R
    return T


def small_map() -> Map:
    """Two keyframes, the second one metre to the right, with two landmarks each; both see landmark 1."""
    map_ = Map()
    first = add_keyframe(map_, 3)
    second = add_keyframe(map_, 3, invert(pose(1.0, 0.0, 0.0)))
    map_.create_landmarks(first, ids_of(0, 1), np.array([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0]]), COVARIANCE)
    map_.create_landmarks(second, ids_of(0, 1), np.array([[1.0, 0.0, 2.0], [1.0, 0.0, 4.0]]), COVARIANCE)
    see(map_, second, 2, 1)
    for keyframe in (first, second):
        log_depth = np.log([2.0, 4.0, 3.0])
        map_.set_depth(
            keyframe, flat_depth(), log_depth, np.full(3, 0.1), predicted_log_depth=log_depth, scale=1.5
        )
        map_.set_velocity(keyframe, np.arange(6.0))
    return map_


def test_landmarks_move_with_the_keyframe_that_created_them() -> None:
    map_ = small_map()
    moved = pose(1.0, 3.0, 0.0, QUARTER)
    map_.correct([1], invert(moved)[None])
    np.testing.assert_allclose(map_.keyframes[1].T_world_camera, moved, atol=1e-15)
    np.testing.assert_array_equal(map_.keyframes[0].T_camera_world, np.eye(4))
    # landmark 1 is seen by both keyframes, and stays with its own
    np.testing.assert_allclose(
        map_.landmarks.position_w, np.array([[0.0, 0, 2], [0.5, 0, 2], [3, 3, 0], [5, 3, 0]]), atol=1e-15
    )
    np.testing.assert_array_equal(map_.landmarks.covariance_w[:2], COVARIANCE)
    np.testing.assert_allclose(map_.landmarks.covariance_w[2:], [np.diag([3.0, 2.0, 1.0])] * 2, atol=1e-15)
    np.testing.assert_array_equal(map_.units, 1.0)
    check(map_)


def test_adjusted_landmarks_go_where_the_adjustment_says() -> None:
    map_ = small_map()
    there = AdjustedLandmarks(ids_of(0, 3), np.array([[0.0, 3.0, 4.0], [1.0, 3.0, 2.0]]), 0.5 * COVARIANCE)
    map_.correct([1], invert(pose(1.0, 3.0, 0.0))[None], adjusted=there)
    landmarks = map_.landmarks
    # 2 is not adjusted and moves along
    np.testing.assert_allclose(
        landmarks.position_w, np.array([[0.0, 3, 4], [0.5, 0, 2], [1, 3, 2], [1, 3, 2]])
    )
    np.testing.assert_array_equal(landmarks.covariance_w[[0, 3]], 0.5 * COVARIANCE)
    np.testing.assert_array_equal(landmarks.covariance_w[[1, 2]], COVARIANCE)
    np.testing.assert_allclose(landmarks.distance_m[[0, 3]], [5.0, 2.0])
    np.testing.assert_allclose(landmarks.direction_w[[0, 3]], np.array([[0, 0.6, 0.8], [0, 0, 1]]))


def test_landmarks_that_are_gone_do_not_move_with_a_keyframe() -> None:
    map_ = small_map()
    map_.remove(ids_of(2))
    map_.correct([1], invert(pose(1.0, 3.0, 0.0))[None])
    np.testing.assert_allclose(map_.landmarks.position_w[2:], [[1, 0, 2], [1, 3, 4]])
    check(map_)


def test_a_similarity_scales_what_a_keyframe_sees_about_its_camera() -> None:
    map_ = small_map()
    T_new = np.stack([np.eye(4), pose(2.0, 0.0, 0.0, QUARTER)])
    map_.correct_similarities(T_new, np.array([1.0, 2.0]))
    first, second = map_.keyframes
    np.testing.assert_allclose(map_.T_world_camera, T_new, atol=1e-15)
    landmarks = map_.landmarks
    expected_w = np.array([[0.0, 0, 2], [0.5, 0, 2], [6, 0, 0], [10, 0, 0]])
    np.testing.assert_allclose(landmarks.position_w, expected_w, atol=1e-15)
    np.testing.assert_allclose(landmarks.covariance_w[2], np.diag([12.0, 8.0, 4.0]), atol=1e-15)
    np.testing.assert_allclose(landmarks.covariance_w[0], COVARIANCE[0])
    np.testing.assert_allclose(landmarks.distance_m[[0, 2, 3]], [2.0, 4.0, 8.0])
    np.testing.assert_allclose(
        landmarks.direction_w[[0, 2, 3]], [[0, 0, 1], [1, 0, 0], [1, 0, 0]], atol=1e-15
    )
    np.testing.assert_allclose(np.exp(first.log_depth), [2.0, 4.0, 3.0])
    np.testing.assert_allclose(np.exp(second.log_depth), [4.0, 8.0, 6.0])
    np.testing.assert_array_equal(second.sigma_log, 0.1)  # relative, so that no scale changes it
    np.testing.assert_allclose(np.exp(second.predicted_log_depth), [2.0, 4.0, 3.0])  # as the network said
    assert (first.scale, second.scale) == (1.5, 3.0)
    np.testing.assert_allclose(second.velocity, [0, 2, 4, 3, 4, 5])
    np.testing.assert_array_equal(map_.units, [1.0, 2.0])


def test_rescaling_keeps_the_origin_and_all_directions() -> None:
    map_ = small_map()
    map_.correct([1], invert(pose(1.0, 3.0, 0.0, QUARTER))[None])
    direction_w = map_.landmarks.direction_w.copy()
    before_w = map_.landmarks.position_w.copy()
    map_.rescale(3.0)
    np.testing.assert_allclose(map_.T_world_camera[0], np.eye(4))
    np.testing.assert_allclose(map_.T_world_camera[1], pose(3.0, 9.0, 0.0, QUARTER), atol=1e-15)
    np.testing.assert_allclose(map_.landmarks.position_w, 3.0 * before_w)
    np.testing.assert_allclose(map_.landmarks.covariance_w[:2], 9.0 * COVARIANCE)
    np.testing.assert_allclose(map_.landmarks.distance_m, [6.0, 3.0 * np.hypot(0.5, 2.0), 6.0, 12.0])
    np.testing.assert_allclose(map_.landmarks.direction_w[:2], direction_w[:2])
    for keyframe in map_.keyframes:
        np.testing.assert_allclose(np.exp(keyframe.log_depth), [6.0, 12.0, 9.0])
        assert keyframe.scale == 4.5
        np.testing.assert_allclose(keyframe.velocity, [0, 3, 6, 3, 4, 5])
    np.testing.assert_array_equal(map_.units, 3.0)


def anchored_to_second(map_: Map) -> AnchoredPose:
    """A camera half a metre in front of the second keyframe."""
    return AnchoredPose.of(invert(pose(1.0, 0.0, 0.5)), map_.keyframes[1])


def world_camera(anchored: AnchoredPose) -> Floats:
    return invert(anchored.T_camera_world)


def test_a_pose_follows_its_keyframe_rigidly() -> None:
    map_ = small_map()
    anchored = anchored_to_second(map_)
    np.testing.assert_allclose(world_camera(anchored), pose(1.0, 0.0, 0.5), atol=1e-15)
    map_.correct([1], invert(pose(1.0, 3.0, 0.0, QUARTER))[None])
    np.testing.assert_allclose(world_camera(anchored), pose(1.5, 3.0, 0.0, QUARTER), atol=1e-15)
    map_.correct([0], pose(5.0, 0.0, 0.0)[None])  # another keyframe
    np.testing.assert_allclose(world_camera(anchored), pose(1.5, 3.0, 0.0, QUARTER), atol=1e-15)


def test_a_pose_follows_the_similarity_of_its_keyframe() -> None:
    map_ = small_map()
    anchored = anchored_to_second(map_)
    map_.correct_similarities(np.stack([np.eye(4), pose(2.0, 0.0, 0.0, QUARTER)]), np.array([7.0, 2.0]))
    np.testing.assert_allclose(world_camera(anchored), pose(3.0, 0.0, 0.0, QUARTER), atol=1e-15)
    # one that is stored afterwards is in the metres of then
    later = AnchoredPose.of(invert(pose(2.5, 0.0, 0.0, QUARTER)), map_.keyframes[1])
    map_.correct_similarities(np.stack([np.eye(4), pose(0.0, 0.0, 0.0)]), np.array([1.0, 3.0]))
    np.testing.assert_allclose(world_camera(anchored), pose(0.0, 0.0, 3.0), atol=1e-15)
    np.testing.assert_allclose(world_camera(later), pose(0.0, 0.0, 1.5), atol=1e-15)


def test_a_pose_follows_the_scale_of_the_whole_map() -> None:
    map_ = small_map()
    anchored = anchored_to_second(map_)
    map_.rescale(4.0)
    np.testing.assert_allclose(world_camera(anchored), pose(4.0, 0.0, 2.0), atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_what_a_pose_sees_of_its_keyframe_s_landmarks_stays_where_it_was_in_the_image(seed: int) -> None:
    """Whatever the correction: pose and landmarks hang on the same keyframe."""
    map_, rng = small_map(), np.random.default_rng(seed)
    anchored = AnchoredPose.of(se3_exp(0.2 * rng.normal(size=6)), map_.keyframes[1])

    def image() -> Floats:
        points_c = transform(anchored.T_camera_world, map_.landmarks.position_w[2:])
        return points_c[:, :2] / points_c[:, 2:]

    before = image()
    map_.correct([1], se3_exp(rng.normal(size=(1, 6))))
    np.testing.assert_allclose(image(), before, atol=1e-12)
    map_.correct_similarities(se3_exp(rng.normal(size=(2, 6))), np.exp(rng.normal(size=2)))
    np.testing.assert_allclose(image(), before, atol=1e-12)
    map_.rescale(0.3)
    np.testing.assert_allclose(image(), before, atol=1e-12)


def test_a_measured_loop_follows_the_metres_of_its_keyframes() -> None:
    edge = Edge(1, 0, pose(0.0, 0.0, 3.0, QUARTER), 0.9, is_loop=True)
    loop = MeasuredLoop.of(edge, np.array([2.0, 1.0]))
    same = loop.in_units(np.array([2.0, 1.0]))
    np.testing.assert_array_equal(same.T_i_j, edge.T_i_j)
    assert same.scale_i_j == 0.9
    # metres of keyframe 1 doubled, those of keyframe 0 tripled
    now = loop.in_units(np.array([6.0, 2.0]))
    np.testing.assert_allclose(now.T_i_j, pose(0.0, 0.0, 6.0, QUARTER))
    assert now.scale_i_j == pytest.approx(0.9 * 2.0 / 3.0)
    assert (now.i, now.j, now.sigmas, now.is_loop) == (1, 0, edge.sigmas, True)
    np.testing.assert_array_equal(edge.T_i_j[:3, 3], [0.0, 0.0, 3.0])  # the measurement stays


def test_a_loop_that_was_applied_asks_for_no_further_correction() -> None:
    map_ = small_map()
    edge = Edge(0, 1, pose(2.0, 0.0, 0.0, QUARTER), 0.5, is_loop=True)
    loop = MeasuredLoop.of(edge, map_.units)
    map_.correct_similarities(np.stack([np.eye(4), edge.T_i_j]), np.array([1.0, edge.scale_i_j]))
    map_.rescale(1.3)
    now = loop.in_units(map_.units)
    assert now.scale_i_j == pytest.approx(1.0)
    first, second = map_.keyframes
    np.testing.assert_allclose(first.T_camera_world @ second.T_world_camera, now.T_i_j, atol=1e-15)


SIMILARITY = Similarity(2.0, pose(3.0, 0.0, 1.0, QUARTER))


def test_a_similarity_moves_cameras_and_is_undone_by_its_inverse() -> None:
    T_b_camera = pose(0.5, -1.0, 2.0)
    T_a_camera = SIMILARITY.camera(T_b_camera)
    np.testing.assert_allclose(T_a_camera[:3, 3], 2.0 * QUARTER @ [0.5, -1.0, 2.0] + [3.0, 0.0, 1.0])
    np.testing.assert_allclose(T_a_camera[:3, :3], QUARTER)
    np.testing.assert_allclose(SIMILARITY.inverse().camera(T_a_camera), T_b_camera, atol=1e-15)
    again = Similarity.of_camera(T_a_camera, T_b_camera, 2.0)
    np.testing.assert_allclose(again.T_a_b, SIMILARITY.T_a_b, atol=1e-15)


def test_a_moved_map_looks_the_same_from_its_cameras() -> None:
    map_, moved = small_map(), small_map()
    moved.move(SIMILARITY)
    for before, after in zip(map_.keyframes, moved.keyframes, strict=True):
        np.testing.assert_allclose(
            transform(after.T_camera_world, moved.landmarks.position_w),
            2.0 * transform(before.T_camera_world, map_.landmarks.position_w),
            atol=1e-12,
        )
    np.testing.assert_array_equal(moved.units, 2.0)
    check(moved)


def test_an_absorbed_map_goes_on_behind_the_other() -> None:
    map_, other = small_map(), small_map()
    other.move(Similarity(1.0, pose(10.0, 0.0, 0.0)))
    last = other.keyframes[1]
    anchored = AnchoredPose.of(invert(pose(11.0, 0.0, 0.5)), last)
    seen_before = [k.landmark_ids.copy() for k in other.keyframes]
    positions = other.landmarks.position_w.copy()
    assert map_.absorb(other) == (2, 4)
    assert [keyframe.id for keyframe in map_.keyframes] == [0, 1, 2, 3]
    assert map_.starts == {0, 2}
    assert map_.keyframes[3] is last
    for keyframe, before in zip(map_.keyframes[2:], seen_before, strict=True):
        np.testing.assert_array_equal(keyframe.landmark_ids, np.where(before >= 0, before + 4, -1))
    np.testing.assert_array_equal(map_.landmarks.position_w[4:], positions)
    np.testing.assert_array_equal(map_.landmarks.anchor_keyframe[4:], [2, 2, 3, 3])
    np.testing.assert_allclose(anchored.T_camera_world, invert(pose(11.0, 0.0, 0.5)), atol=1e-12)
    map_.fuse(ids_of(7), ids_of(1))  # what both maps had becomes one landmark
    assert map_.resolve(ids_of(7)) == 1
    check(map_)
    create(map_, map_.keyframes[3], [])
    add_keyframe(map_, 3)
    assert map_.keyframes[4].id == 4


def test_a_fused_landmark_of_an_absorbed_map_is_still_found() -> None:
    map_, other = small_map(), small_map()
    other.fuse(ids_of(3), ids_of(0))
    map_.absorb(other)
    np.testing.assert_array_equal(map_.resolve(ids_of(3, 7)), [3, 4])
    check(map_)
