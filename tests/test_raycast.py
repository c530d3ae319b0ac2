# SPDX-License-Identifier: Apache-2.0
"""Rendered images of meshes whose every pixel is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.raycast import render_mesh
from slamdepth.types import Camera

CAMERA = Camera(60, 40, 40.0, 40.0, 29.5, 19.5)
BEHIND = (10, 20, 30)


def wall(z_m: float, colors: Sequence[Sequence[float]], *, is_turned: bool = False) -> Mesh:
    """A square of 1 m across the camera's axis, facing a camera at the origin unless turned away."""
    corners = np.array([[-0.5, -0.5, z_m], [0.5, -0.5, z_m], [0.5, 0.5, z_m], [-0.5, 0.5, z_m]], np.float32)
    triangles = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    if is_turned:
        triangles = triangles[:, ::-1].copy()
    return Mesh(corners, triangles, np.array(colors, np.float32))


def both(one: Mesh, other: Mesh) -> Mesh:
    return Mesh(
        np.concatenate([one.vertices_m, other.vertices_m]),
        np.concatenate([one.triangles, other.triangles + len(one.vertices_m)]),
        np.concatenate([one.colors, other.colors]),
    )


def test_a_wall_is_where_it_projects_to_and_colours_run_between_its_corners() -> None:
    left_black = [[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 0.5, 0.0], [0.0, 0.0, 0.0]]
    image = render_mesh(wall(2.0, left_black), CAMERA, np.eye(4), BEHIND)
    assert image.shape == (40, 60, 3)
    assert image.dtype == np.uint8
    is_wall = (image != BEHIND).any(axis=2)
    expected = np.zeros((40, 60), bool)
    expected[10:30, 20:40] = True  # 40 px / 2 m * 1 m
    np.testing.assert_array_equal(is_wall, expected)
    row = image[20, 20:40].astype(float)
    at = (np.arange(20) + 0.5) / 20
    np.testing.assert_allclose(row[:, 0], 255 * at, rtol=0.05, atol=1.5)  # seen nearly head on: hardly shaded
    np.testing.assert_allclose(row[:, 1], row[:, 0] / 2, atol=1.0)
    assert (row[:, 2] == 0).all()


def test_a_wall_is_seen_from_its_front_only() -> None:
    T = np.eye(4)
    T[:3, :3] = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]  # looks back from 4 m
    T[2, 3] = 4.0
    red = [[1, 0, 0]] * 4
    from_behind = render_mesh(wall(2.0, red), CAMERA, T, BEHIND)
    assert (from_behind == BEHIND).all()
    towards = render_mesh(wall(2.0, red, is_turned=True), CAMERA, T, BEHIND)
    assert ((towards != BEHIND).any(axis=2)).sum() == 400


def test_the_back_of_a_near_wall_does_not_hide_a_far_wall() -> None:
    red, blue = [[1, 0, 0]] * 4, [[0, 0, 1]] * 4
    hidden = render_mesh(both(wall(1.0, red), wall(2.0, blue)), CAMERA, np.eye(4), BEHIND)
    open_ = render_mesh(both(wall(1.0, red, is_turned=True), wall(2.0, blue)), CAMERA, np.eye(4), BEHIND)
    assert hidden[20, 30, 0] > 240
    assert hidden[20, 30, 2] == 0
    assert open_[20, 30, 2] > 240
    assert open_[20, 30, 0] == 0


def test_a_mesh_without_colours_is_grey_and_shaded() -> None:
    black = [[0, 0, 0]] * 4
    flat = wall(2.0, black)
    farther = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 0]], np.float32)
    steep = Mesh(flat.vertices_m + farther, flat.triangles, flat.colors)
    one, other = (render_mesh(m, CAMERA, np.eye(4), BEHIND) for m in (flat, steep))
    assert one[20, 25, 0] == one[20, 25, 1] == one[20, 25, 2] > 200
    assert BEHIND[0] < other[20, 25, 0] < one[20, 25, 0]


def test_an_empty_mesh_is_background_and_rendering_is_deterministic() -> None:
    assert (render_mesh(Mesh.empty(), CAMERA, np.eye(4), BEHIND) == BEHIND).all()
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(300, 3)).astype(np.float32) + np.array([0, 0, 3], np.float32)
    triangles = rng.permutation(300).reshape(-1, 3).astype(np.int32)
    mesh = Mesh(vertices, triangles, rng.uniform(size=(300, 3)).astype(np.float32))
    first = render_mesh(mesh, CAMERA, np.eye(4), BEHIND)
    assert (first != BEHIND).any()
    np.testing.assert_array_equal(first, render_mesh(mesh, CAMERA, np.eye(4), BEHIND))
