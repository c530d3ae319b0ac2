# SPDX-License-Identifier: Apache-2.0
"""The height of a camera over a floor or a road, among triangulated landmarks of a map of any size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamdepth.depth.alignment import as_given
from slamdepth.errors import DatasetError
from slamdepth.geometry import se3_exp
from slamdepth.mapping.floor import find_floor
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.scale.camera_height import from_camera_height
from slamdepth.scale.known_size import rescaled
from slamdepth.types import Camera, DepthKind, DepthPrediction, Frame, Trajectory
from slamdepth.typing import Floats

CAMERA = Camera(64, 24, 37.0, 37.0, 31.5, 11.5)
DOWN = np.array([0.0, 1.0, 0.0])


def seen_from(poses: Floats, points: Floats, reach_m: float, *, has_gravity: bool = True) -> Reconstruction:
    """A map whose keyframes see the points before them, and whose network knows nothing."""
    keyframes = []
    for number, T in enumerate(poses):
        local = (points - T[:3, 3]) @ T[:3, :3]
        x, y, z = local.T
        rows = np.flatnonzero((z > 0.3) & (z < reach_m) & (np.abs(x) < z) & (np.abs(y) < 0.8 * z))
        frame = StoredFrame(Frame(number, number / 10, np.zeros((24, 64, 3), np.uint8), CAMERA))
        nothing = StoredPrediction(DepthPrediction(np.zeros((24, 64), np.float32), DepthKind.METRIC))
        keyframes.append(Keyframe(number, frame, T, np.zeros((len(rows), 2)), 1.0, nothing, as_given, rows))
    trajectory = Trajectory(np.arange(len(poses)) / 10.0, poses)
    return Reconstruction(trajectory, tuple(keyframes), points, DOWN if has_gravity else None)


def road(seed: int = 0, height_m: float = 1.65, hill: float = 0.06) -> Reconstruction:
    """A car on a winding, hilly road between hedges, its camera ``height_m`` over the road."""
    rng = np.random.default_rng(seed)

    def middle(s: Floats) -> tuple[Floats, Floats, Floats]:
        heading, slope = 0.5 * np.sin(s / 25.0), hill * np.sin(s / 12.0)
        step = s[1] - s[0]
        x, y, z = (np.cumsum(v) * step for v in (np.sin(heading), -slope, np.cos(heading)))
        return np.stack([x, y, z], axis=1), heading, slope

    line, heading, slope = middle(np.arange(0.0, 90.0, 0.1))
    at = rng.integers(0, len(line), 1500)
    across = rng.uniform(-5, 5, 1500)
    side = np.stack([np.cos(heading[at]), np.zeros(1500), -np.sin(heading[at])], axis=1)
    ground = line[at] + across[:, None] * side + [0.0, height_m, 0.0] + rng.normal(0, 0.03, (1500, 1)) * DOWN
    hedge = line[at] + np.where(across > 0, 6.0, -6.0)[:, None] * side
    hedge[:, 1] += height_m - rng.uniform(0.0, 5.0, 1500)
    stops = np.arange(0, 650, 20)
    tangents = np.zeros((len(stops), 6))
    tangents[:, 4] = heading[stops]
    poses = se3_exp(tangents) @ se3_exp(np.stack([[0, 0, 0, a, 0, 0] for a in slope[stops]]))
    poses[:, :3, 3] = line[stops]
    return seen_from(poses, np.concatenate([ground, hedge]), 25.0)


def hand_held(
    seed: int = 0, floor_m: float = 1.4, table_m: float | None = 0.7, *, has_gravity: bool = True
) -> Reconstruction:
    """A camera moved by hand in a room with a floor, maybe a table, and boxes; height varies."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, 20)
    turned = [0 * t - 0.3, 0.1 * np.sin(5 * t), 0 * t]
    moved = np.stack([1.5 * t, 0.25 * np.sin(6 * t), 0.4 * t, *turned], axis=1)
    poses = se3_exp(moved)
    poses = np.linalg.inv(poses[0]) @ poses
    level = poses[0] @ np.linalg.inv(se3_exp(moved[:1]))[0]
    floor = np.column_stack([rng.uniform(-3, 4, 900), np.full(900, floor_m), rng.uniform(0, 5, 900)])
    things = np.column_stack([rng.uniform(-3, 4, 900), rng.uniform(-1, floor_m, 900), rng.uniform(2, 5, 900)])
    points = [floor, things]
    if table_m is not None:
        points.append(
            np.column_stack([rng.uniform(-1, 2, 1200), np.full(1200, table_m), rng.uniform(1, 3, 1200)])
        )
    world = np.concatenate(points) + rng.normal(0, 0.005, (sum(map(len, points)), 3))
    made = seen_from(poses, world @ level[:3, :3].T + level[:3, 3], 6.0, has_gravity=has_gravity)
    down = level[:3, :3] @ DOWN
    return made if not has_gravity else Reconstruction(made.trajectory, made.keyframes, made.points_m, down)


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_of_a_car_is_as_high_over_the_road_wherever_that_bends(seed: int) -> None:
    floor = find_floor(road(seed))
    assert floor is not None
    assert floor.is_mounted
    assert floor.height == pytest.approx(1.65, rel=0.04)
    assert floor.sigma_log < 0.06


@pytest.mark.parametrize("scale", [1 / 18, 1.0, 40.0])
def test_a_road_in_a_map_of_any_size_gives_the_scale(scale: float) -> None:
    found = from_camera_height(rescaled(road(), scale), 1.65)
    assert found.factor == pytest.approx(1 / scale, rel=0.04)
    assert "over the ground around each keyframe" in found.how


@pytest.mark.parametrize("table_m", [None, 0.7])
@pytest.mark.parametrize("seed", range(3))
def test_a_hand_held_camera_is_over_the_floor_and_not_the_table(seed: int, table_m: float | None) -> None:
    floor = find_floor(hand_held(seed, table_m=table_m))
    assert floor is not None
    assert not floor.is_mounted
    assert floor.height == pytest.approx(1.4, rel=0.03)
    assert abs(math.log(floor.height / 1.4)) < 3 * floor.sigma_log


@settings(max_examples=8, deadline=None)
@given(st.floats(0.02, 50.0))
def test_the_size_of_the_map_does_not_matter(scale: float) -> None:
    found = from_camera_height(rescaled(hand_held(), scale), 1.4)
    assert found.factor * scale == pytest.approx(1.0, rel=0.03)


def test_the_same_map_and_seed_give_the_same_height() -> None:
    assert find_floor(hand_held(), seed=1) == find_floor(hand_held(), seed=1)


def test_clutter_is_no_floor() -> None:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 10)
    clutter = np.column_stack([rng.uniform(-3, 4, 1500), rng.uniform(-2, 2, 1500), rng.uniform(1, 6, 1500)])
    made = seen_from(poses, clutter, 8.0)
    assert find_floor(made) is None
    with pytest.raises(DatasetError, match="no floor was found below the camera"):
        from_camera_height(made, 1.5)
    assert find_floor(Reconstruction(made.trajectory, (), made.points_m)) is None
