# SPDX-License-Identifier: Apache-2.0
"""The pose graph on exact synthetic circles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slamdepth.backend.pose_graph import Edge, optimise_pose_graph
from slamdepth.errors import TrackingError
from slamdepth.geometry import invert, rotation_angle_rad, se3_exp, so3_exp

SIGMAS = (0.01, 0.02, 0.02)


def circle(count: int, turns: float = 1.0, radius_m: float = 2.0) -> np.ndarray:
    """Poses (count, 4, 4) on a circle, looking along it, at slowly changing height."""
    angle = 2 * np.pi * turns * np.arange(count) / count
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = so3_exp(np.stack([0.1 * np.sin(angle), -angle, 0.05 * np.cos(angle)], axis=1))
    T[:, :3, 3] = np.stack(
        [radius_m * np.cos(angle), 0.2 * np.sin(2 * angle), radius_m * np.sin(angle)], axis=1
    )
    return invert(T[:1]) @ T


def measured(T: np.ndarray, i: int, j: int, *, scales: np.ndarray | None = None, **more: Any) -> Edge:
    """The exact edge between keyframes whose own metres are ``scales`` metres of the world."""
    s = np.ones(len(T)) if scales is None else scales
    T_i_j = invert(T[i]) @ T[j]
    T_i_j[:3, 3] /= s[i]
    return Edge(i, j, T_i_j, scale_i_j=float(s[j] / s[i]), sigmas=SIGMAS, **more)


def odometry(T: np.ndarray, rng: np.random.Generator | None = None, drift: float = 0.0) -> list[Edge]:
    edges = [measured(T, k, k + 1) for k in range(len(T) - 1)]
    if rng is None:
        return edges
    bias = np.array([drift, 0.5 * drift, drift, 0.2 * drift, drift, 0.3 * drift])
    return [
        replace(edge, T_i_j=edge.T_i_j @ se3_exp(bias + 0.3 * drift * rng.normal(size=6))) for edge in edges
    ]


def chained(edges: list[Edge], count: int) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    for k, edge in enumerate(edges):
        T[k + 1] = T[k] @ edge.T_i_j
    return T


def position_rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((a[:, :3, 3] - b[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.parametrize("with_scale", [False, True])
def test_exact_measurements_give_exact_poses(with_scale: bool) -> None:
    T = circle(24)
    edges = [*odometry(T), measured(T, 0, 23, is_loop=True)]
    perturbed = T @ se3_exp(0.02 * np.random.default_rng(0).normal(size=(24, 6)))
    perturbed[0] = T[0]
    result = optimise_pose_graph(perturbed, edges, with_scale=with_scale)
    np.testing.assert_allclose(result.T_world_camera, T, atol=1e-9)
    np.testing.assert_allclose(result.scales, 1.0, atol=1e-9)
    assert result.is_inlier.all()
    assert result.error_after < 1e-12 < result.error_before


def test_a_drifted_circle_closes() -> None:
    T = circle(60)
    edges = odometry(T, np.random.default_rng(1), drift=0.004)
    start = chained(edges, 60)
    edges += [measured(T, k, 57 + k, is_loop=True) for k in range(3)]
    result = optimise_pose_graph(start, edges)
    assert position_rmse(start, T) > 0.25
    assert position_rmse(result.T_world_camera, T) < 0.25 * position_rmse(start, T)
    assert result.is_inlier.all()
    end = invert(T[59]) @ result.T_world_camera[59]
    assert np.linalg.norm(end[:3, 3]) < 0.02
    assert rotation_angle_rad(end[:3, :3]) < 0.02


def test_scale_drift_is_recovered_with_similarities() -> None:
    T = circle(60)
    true_scales = np.exp(-0.006 * np.arange(60))  # a metre of the last keyframe is 0.7 m
    edges = [
        replace(measured(T, k, k + 1, scales=true_scales), scale_i_j=1.0) for k in range(59)
    ]  # the odometry does not see the scale change
    start = chained(edges, 60)
    edges += [measured(T, k, 57 + k, scales=true_scales, is_loop=True) for k in range(3)]
    similar = optimise_pose_graph(start, edges, with_scale=True)
    rigid = optimise_pose_graph(start, edges, with_scale=False)
    assert position_rmse(similar.T_world_camera, T) < 0.02
    np.testing.assert_allclose(np.log(similar.scales), np.log(true_scales), atol=0.02)
    assert position_rmse(similar.T_world_camera, T) < 0.2 * position_rmse(rigid.T_world_camera, T)


def test_scales_follow_the_convention_of_the_edge() -> None:
    T, scales = circle(5), np.array([1.0, 1.2, 0.7, 1.5, 2.0])
    edges = [measured(T, k, k + 1, scales=scales) for k in range(4)]
    result = optimise_pose_graph(np.tile(np.eye(4), (5, 1, 1)), edges, with_scale=True)
    np.testing.assert_allclose(result.T_world_camera, T, atol=1e-6)
    np.testing.assert_allclose(result.scales, scales, atol=1e-6)
    # A start at the solution, and one that fixes another keyframe, stay at it.
    again = optimise_pose_graph(T, edges, with_scale=True, scales=scales, fixed=3)
    np.testing.assert_allclose(again.T_world_camera, T, atol=1e-9)
    np.testing.assert_allclose(again.scales, scales, atol=1e-9)


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_false_loops_are_rejected(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    T = circle(120, turns=2.0)  # the second turn sees what the first saw
    edges = odometry(T, rng, drift=0.002)
    start = chained(edges, 120)
    for k in range(0, 56, 4):
        T_i_j = (
            invert(T[k]) @ T[k + 60] @ se3_exp(rng.normal(size=6) * [0.01, 0.01, 0.01, 0.005, 0.005, 0.005])
        )
        edges.append(Edge(k, k + 60, T_i_j, sigmas=SIGMAS, is_loop=True))
    first_false = len(edges)
    for _ in range(6):  # 6 of 20 loops: 30 %
        i, j = rng.choice(120, size=2, replace=False)
        wrong = se3_exp(np.concatenate([rng.normal(size=3), 0.5 * rng.normal(size=3)]))
        edges.append(Edge(int(i), int(j), wrong, sigmas=SIGMAS, is_loop=True))
    result = optimise_pose_graph(start, edges, with_scale=with_scale)
    clean = optimise_pose_graph(start, edges[:first_false], with_scale=with_scale)
    assert not result.is_inlier[first_false:].any()
    assert result.is_inlier[119:first_false].mean() > 0.9
    assert position_rmse(result.T_world_camera, clean.T_world_camera) < 0.01
    assert position_rmse(result.T_world_camera, T) < 0.5 * position_rmse(start, T)


def test_nothing_but_odometry_stays() -> None:
    T = circle(10)
    result = optimise_pose_graph(T, odometry(T))
    np.testing.assert_allclose(result.T_world_camera, T, atol=1e-12)


def test_one_keyframe_needs_no_edge() -> None:
    T = circle(4)[2:3]
    np.testing.assert_allclose(optimise_pose_graph(T, []).T_world_camera, T, atol=1e-12)


def test_the_same_graph_gives_the_same_poses() -> None:
    T = circle(40)
    edges = odometry(T, np.random.default_rng(3), drift=0.003)
    start = chained(edges, 40)
    edges.append(measured(T, 0, 39, is_loop=True))
    first, second = (optimise_pose_graph(start, edges, with_scale=True) for _ in range(2))
    np.testing.assert_array_equal(first.T_world_camera, second.T_world_camera)


def test_arguments_are_not_changed() -> None:
    T = circle(6)
    start = T @ se3_exp(np.full((6, 6), 0.01))
    before = start.copy()
    optimise_pose_graph(start, odometry(T))
    np.testing.assert_array_equal(start, before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda T, e: (T[:0], []), "K > 0"),
        (lambda T, e: (T, e[:2] + e[3:]), "not connected"),
        (lambda T, e: (T, [*e[:2], replace(e[2], is_loop=True), *e[3:]]), "not connected"),
        (lambda T, e: (T, [*e, replace(e[0], j=9)]), "edge 4 .* must join two"),
        (lambda T, e: (T, [*e, replace(e[0], j=0)]), "must join two"),
        (lambda T, e: (T * np.where(np.arange(5) == 3, np.nan, 1.0)[:, None, None], e), "keyframe 3 is not"),
        (lambda T, e: (T, [replace(e[0], T_i_j=np.full((4, 4), np.nan)), *e[1:]]), "edge 0 .* finite"),
        (lambda T, e: (T, [replace(e[0], sigmas=(0.0, 1.0, 1.0)), *e[1:]]), "sigmas must be positive"),
        (lambda T, e: (T, [replace(e[0], scale_i_j=-1.0), *e[1:]]), "scale and its three sigmas"),
    ],
)
def test_unsound_graphs_are_refused(
    change: Callable[[np.ndarray, list[Edge]], tuple[np.ndarray, list[Edge]]], message: str
) -> None:
    T = circle(5)
    poses, edges = change(T, odometry(T))
    with pytest.raises(TrackingError, match=message):
        optimise_pose_graph(poses, edges)


def test_a_fixed_keyframe_must_exist() -> None:
    T = circle(5)
    with pytest.raises(TrackingError, match="fixed keyframe 5"):
        optimise_pose_graph(T, odometry(T), fixed=5)
