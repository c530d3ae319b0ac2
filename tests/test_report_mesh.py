# SPDX-License-Identifier: Apache-2.0
"""Where a mesh is looked at from, and its images in a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import leave_out_plots
from report_data import bare_data, full_data

from slamdepth.errors import OutputError
from slamdepth.geometry import invert, look_at, project, so3_exp, transform
from slamdepth.io import read_image_rgb
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report import MeshImage, build_html, build_summary, render_mesh_images, write_mesh_png
from slamdepth.report.viewpoints import from_above, guessed_gravity, ideal_camera, over_the_shoulder
from slamdepth.types import Trajectory

GRAVITY_W = np.array([0.0, 1.0, 0.0])
CAMERA = ideal_camera(90, 60, 50.0)


def corner_room() -> Mesh:
    """A floor 1.5 m below the camera and a wall 3 m ahead of it, in patches of 10 cm; their fronts inside."""
    at = np.arange(-1.5, 1.5, 0.1)
    u, v = (grid.ravel() for grid in np.meshgrid(at, at))
    step = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1)]
    floor = np.stack([[u + du, np.full_like(u, 1.5), v + 1.5 + dv] for du, dv in step], axis=0)
    wall = np.stack([[u + du, v + dv, np.full_like(u, 3.0)] for du, dv in step], axis=0)
    vertices = np.concatenate([floor, wall], axis=2).transpose(2, 0, 1).reshape(-1, 3)
    quads = np.arange(len(vertices)).reshape(-1, 4)
    floor_quads, wall_quads = quads[: len(u)], quads[len(u) :]
    triangles = [floor_quads[:, [0, 1, 2]], floor_quads[:, [1, 3, 2]]]
    triangles += [wall_quads[:, [0, 2, 1]], wall_quads[:, [1, 2, 3]]]
    fronts = np.concatenate(triangles).astype(np.int32)
    colors = np.where(np.arange(len(vertices))[:, None] < 4 * len(u), [0.8, 0.2, 0.1], [0.1, 0.3, 0.8])
    return Mesh(vertices.astype(np.float32), fronts, colors.astype(np.float32))


def walk() -> np.ndarray:
    """Ten level cameras side by side that look at the wall, turned and tipped a little."""
    T = np.tile(np.eye(4), (10, 1, 1))
    T[:, 0, 3] = np.linspace(-0.5, 0.5, 10)
    yaw = np.linspace(-0.5, 0.5, 10)[:, None] * GRAVITY_W
    T[:, :3, :3] = so3_exp(yaw) @ so3_exp(np.linspace(-0.2, -0.6, 10)[:, None] * [1.0, 0.0, 0.0])
    return T


def room_run(gravity_w: np.ndarray | None = GRAVITY_W) -> Reconstruction:
    run = bare_data().reconstruction
    return replace(run, trajectory=Trajectory(np.arange(10.0), walk()), gravity_w=gravity_w)


def test_from_above_all_is_in_the_image_and_the_eye_is_above_on_the_side_of_the_fronts() -> None:
    mesh, path = corner_room(), walk()[:, :3, 3]
    for gravity_w in (GRAVITY_W, so3_exp(np.array([0.3, 0.0, 0.1])) @ GRAVITY_W):
        T = from_above(mesh, path, gravity_w, CAMERA)
        points = np.concatenate([mesh.vertices_m.astype(np.float64), path])
        px, z = project(CAMERA, transform(invert(T), points))
        inside = (z > 0) & (px > -0.5).all(axis=1) & (px < [89.5, 59.5]).all(axis=1)
        assert inside.mean() > 0.97
        assert inside[-len(path) :].all()
        assert np.ptp(px[:, 0]) > 60 or np.ptp(px[:, 1]) > 40  # and fills it
        np.testing.assert_allclose(T[:3, 0] @ gravity_w, 0.0, atol=1e-12)
        assert T[:3, 3] @ gravity_w < 0
        assert T[2, 3] < 3.0


def test_over_the_shoulder_is_a_step_behind_the_path_and_level() -> None:
    T = over_the_shoulder(corner_room(), walk(), GRAVITY_W, CAMERA)
    assert T is not None
    nearest = np.linalg.norm(walk()[:, :3, 3] - T[:3, 3], axis=1).min()
    assert 0.3 < nearest < 2.0
    assert T[2, 3] < 0
    np.testing.assert_allclose(T[:3, 0] @ GRAVITY_W, 0.0, atol=1e-12)
    straight_down = look_at(np.zeros(3), GRAVITY_W, np.array([0.0, 0.0, -1.0]))[None]
    assert over_the_shoulder(corner_room(), straight_down, GRAVITY_W, CAMERA) is None
    away = walk() @ np.diag([-1.0, 1.0, -1.0, 1.0])
    assert over_the_shoulder(corner_room(), away, GRAVITY_W, CAMERA) is None


def test_gravity_is_guessed_from_cameras_that_were_held_level() -> None:
    R = so3_exp(np.array([0.7, 0.2, -0.3]))
    T = walk()
    T[:, :3, :3] = R @ T[:, :3, :3]
    np.testing.assert_allclose(guessed_gravity(T), R @ GRAVITY_W, atol=1e-9)
    assert walk()[:, :3, 1].mean(axis=0) @ GRAVITY_W < 0.96  # their y axes alone tell less
    still = np.tile(np.eye(4), (5, 1, 1))
    np.testing.assert_allclose(guessed_gravity(still), GRAVITY_W)
    upside_down = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
    np.testing.assert_allclose(guessed_gravity(upside_down), GRAVITY_W)


def test_two_images_say_what_they_know_of_gravity() -> None:
    known, guessed = (render_mesh_images(corner_room(), room_run(gravity)) for gravity in (GRAVITY_W, None))
    assert len(known) == len(guessed) == 2
    assert "by gravity" in known[0].caption
    assert "guessed" in guessed[0].caption
    for one in known:
        colours = one.image_rgb.reshape(-1, 3).astype(int)
        red, blue = colours[:, 0] > colours[:, 2] + 60, colours[:, 2] > colours[:, 0] + 60
        assert red.mean() > 0.05
        assert blue.mean() > 0.05
    again = render_mesh_images(corner_room(), room_run())
    for one, other in zip(known, again, strict=True):
        np.testing.assert_array_equal(one.image_rgb, other.image_rgb)


@pytest.mark.parametrize("poses", [0, 1])
def test_little_is_drawn_of_little(poses: int) -> None:
    run = room_run()
    run = replace(run, trajectory=Trajectory(np.arange(float(poses)), walk()[:poses]))
    assert render_mesh_images(Mesh.empty(), run) == ()
    assert len(render_mesh_images(corner_room(), run)) == 2 * poses


def test_the_path_is_broken_where_frames_were_lost() -> None:
    run = room_run()
    lost = replace(run, trajectory=Trajectory(np.r_[0.0:5.0, 30.0:35.0], walk()))
    blue = []
    for one in (run, lost):
        image = render_mesh_images(corner_room(), one)[0].image_rgb.astype(int)
        blue.append((np.abs(image - (23, 105, 212)).sum(axis=2) < 30).sum())
    assert 0 < blue[1] < blue[0]


def test_the_page_shows_them_and_the_file_has_them_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_out_plots(monkeypatch)
    image = np.full((6, 9, 3), (200, 100, 50), np.uint8)
    images = (MeshImage("One <view>", "What & why.", image), MeshImage("Other", "Too.", image // 2))
    data = replace(full_data(), mesh_images=images)
    page = build_html(data, build_summary(data))
    for text in ("One &lt;view&gt;", "What &amp; why.", "Other"):
        assert text in page
    without = build_html(full_data(), build_summary(data))
    assert page.count("data:image/jpeg") == without.count("data:image/jpeg") + 2
    write_mesh_png(tmp_path / "mesh.png", images)
    read = read_image_rgb(tmp_path / "mesh.png")
    np.testing.assert_array_equal(read[:, :9], image)
    np.testing.assert_array_equal(read[:, -9:], image // 2)
    assert (read[:, 9:-9] == 255).all()
    with pytest.raises(OutputError, match="cannot be written"):
        write_mesh_png(tmp_path / "absent" / "mesh.png", images)


def test_the_page_says_that_there_is_no_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_plots(monkeypatch)
    page = build_html(bare_data(), build_summary(bare_data()))
    assert "no image of one" in page
    assert "no image of one" not in build_html(full_data(), build_summary(full_data()))
