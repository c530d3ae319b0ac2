# SPDX-License-Identifier: Apache-2.0
"""Scores of surfaces whose distances are known, and surfaces from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from surfaces import joined, sphere, wall

from slamdepth.errors import DatasetError
from slamdepth.evaluation import AlignedScores, Surface, score_surface, surface_figures, vertex_errors_m
from slamdepth.evaluation.surface_file import read_surface
from slamdepth.geometry import so3_exp
from slamdepth.io import encode_ply, write_point_cloud


@pytest.mark.parametrize("distance_m", [0.0, 0.03, 0.2])
def test_two_parallel_walls_are_their_distance_apart(distance_m: float) -> None:
    score = score_surface(wall(2.0 + distance_m), wall(2.0))
    for one in (score.accuracy, score.completion):
        assert [one.median_m, one.mean_m, one.rmse_m] == pytest.approx([distance_m] * 3, abs=1e-5)
    assert score.chamfer_m == pytest.approx(distance_m, abs=1e-5)
    for threshold_m, within in score.within.items():
        assert within.precision == within.recall == within.f_score == float(distance_m <= threshold_m)
    assert score.judged == 1.0


def test_half_a_wall_is_accurate_and_half_complete() -> None:
    score = score_surface(wall(2.0, width_m=0.5), wall(2.0))
    assert score.accuracy.rmse_m == pytest.approx(0.0, abs=1e-5)
    within = score.within[0.05]
    assert within.precision == 1.0
    assert within.recall == pytest.approx(0.55, abs=0.01)  # the half, and 5 cm beside it
    assert within.f_score == pytest.approx(2 * 0.55 / 1.55, abs=0.01)
    # the other half is 0 to 0.5 m away from it, evenly
    assert score.completion.mean_m == pytest.approx(0.125, abs=0.005)
    assert score.completion.rmse_m == pytest.approx(np.sqrt(0.5**3 / 3), abs=0.005)


def test_a_sphere_is_off_by_the_difference_of_radii() -> None:
    score = score_surface(sphere(0.54), sphere(0.5))
    assert score.accuracy.median_m == pytest.approx(0.04, abs=2e-4)
    assert score.completion.median_m == pytest.approx(0.04, abs=2e-4)
    assert (score.within[0.02].f_score, score.within[0.05].f_score) == (0.0, 1.0)


def test_the_density_of_vertices_does_not_count() -> None:
    """Half of the estimate is 10 cm off; it has a hundred times as many triangles as the other half."""
    right = wall(2.0, width_m=0.5, patches=2)
    off = wall(2.1, width_m=0.5, patches=20)
    off = Surface(off.vertices_m + np.array([0.5, 0, 0], np.float32), off.triangles)
    estimate = joined(right, off)
    assert score_surface(estimate, wall(2.0)).within[0.05].precision == pytest.approx(0.5, abs=0.01)


def test_the_density_of_a_cloud_does_not_count() -> None:
    rng = np.random.default_rng(0)
    left = np.column_stack([rng.uniform(0.0, 0.5, 400_000), rng.uniform(size=400_000), np.full(400_000, 2.0)])
    right = np.column_stack([rng.uniform(0.5, 1.0, 20_000), rng.uniform(size=20_000), np.full(20_000, 2.1)])
    cloud = Surface.cloud(np.concatenate([left, right]).astype(np.float32))
    score = score_surface(cloud, wall(2.0))
    assert score.points < 15_000
    assert score.within[0.05].precision == pytest.approx(0.5, abs=0.02)
    assert score.completion.median_m < 0.01


def test_a_far_stray_counts_half_a_metre() -> None:
    stray = Surface(wall(50.0, 0.1, 0.1, patches=1).vertices_m, wall(50.0, 0.1, 0.1, patches=1).triangles)
    score = score_surface(joined(wall(2.0), stray), wall(2.0))
    share = 0.01 / 1.01
    assert score.accuracy.rmse_m == pytest.approx(0.5 * np.sqrt(share), rel=0.1)
    assert score.accuracy.median_m == pytest.approx(0.0, abs=1e-5)


def test_only_what_the_reference_can_judge_counts_for_accuracy() -> None:
    estimate = joined(wall(2.0), wall(2.3))
    near = score_surface(estimate, wall(2.0), lambda points: points[:, 2] < 2.1)
    assert near.within[0.02].precision == 1.0
    assert near.judged == pytest.approx(0.5, abs=0.01)
    assert score_surface(estimate, wall(2.0)).within[0.02].precision == pytest.approx(0.5, abs=0.01)
    errors = vertex_errors_m(estimate, wall(2.0), lambda points: points[:, 2] < 2.1)
    half = len(errors) // 2
    np.testing.assert_allclose(errors[:half], 0.0, atol=1e-6)
    assert np.isnan(errors[half:]).all()


def test_a_surface_is_moved_by_a_similarity() -> None:
    T = np.eye(4)
    T[:3, :3] = 2.0 * so3_exp(np.array([0.1, -0.2, 0.3]))
    T[:3, 3] = (1.0, 2.0, 3.0)
    one = wall(2.0)
    score = score_surface(one.moved(T).moved(np.asarray(np.linalg.inv(T), np.float64)), one)
    assert score.within[0.02].f_score == 1.0
    assert score.accuracy.rmse_m < 1e-5


def test_the_same_surfaces_give_the_same_figures() -> None:
    assert score_surface(sphere(0.52), sphere(0.5)) == score_surface(sphere(0.52), sphere(0.5))


def test_nothing_to_score_is_an_error() -> None:
    nothing = Surface.cloud(np.zeros((0, 3), np.float32))
    with pytest.raises(DatasetError, match="the estimate has no surface"):
        score_surface(nothing, wall(2.0))
    with pytest.raises(DatasetError, match="the reference has no surface"):
        score_surface(wall(2.0), nothing)
    with pytest.raises(DatasetError, match="are both in one frame"):
        score_surface(wall(2.0), wall(2.0), lambda points: np.zeros(len(points), bool))
    with pytest.raises(DatasetError, match="is it metres"):
        score_surface(Surface.cloud(np.array([[0, 0, 0], [1e6, 1e6, 1e6]], np.float32)), wall(2.0))


def test_unknown_figures_have_the_same_keys() -> None:
    score = score_surface(wall(2.0), wall(2.0))
    known, unknown = surface_figures(AlignedScores(score, score)), surface_figures(None)
    assert known.keys() == unknown.keys()
    for key in known:
        assert known[key].keys() == unknown[key].keys()
        assert known[key]["within"].keys() == unknown[key]["within"].keys() == {"2cm", "5cm", "10cm"}


def write_mesh(path: Path, surface: Surface) -> Path:
    colours = np.zeros(surface.vertices_m.shape, np.uint8)
    path.write_bytes(encode_ply(surface.vertices_m, colours, surface.triangles.astype(np.int32)))
    return path


def test_meshes_and_clouds_are_read_from_files(tmp_path: Path) -> None:
    mesh = read_surface(write_mesh(tmp_path / "wall.ply", wall(2.0)))
    np.testing.assert_array_equal(mesh.vertices_m, wall(2.0).vertices_m)
    np.testing.assert_array_equal(mesh.triangles, wall(2.0).triangles)
    write_point_cloud(tmp_path / "cloud.ply", wall(2.0).vertices_m, np.zeros((121, 3), np.uint8))
    cloud = read_surface(tmp_path / "cloud.ply")
    assert (cloud.vertices_m.shape, cloud.triangles.shape) == ((121, 3), (0, 3))


def test_vertices_that_are_not_finite_are_dropped_with_their_triangles(tmp_path: Path) -> None:
    one = wall(2.0, patches=2)
    one.vertices_m[0] = np.nan
    read = read_surface(write_mesh(tmp_path / "wall.ply", one))
    assert len(read.vertices_m) == 8
    assert len(read.triangles) == 7
    np.testing.assert_allclose(read.vertices_m[:, 2], 2.0)
    assert read.triangles.max() == 7


def test_files_that_hold_no_surface_are_named(tmp_path: Path) -> None:
    (tmp_path / "damaged.ply").write_bytes(b"ply\nformat ascii 1.0\nelement")
    (tmp_path / "mesh.glb").write_bytes(b"glTF")
    for name, message in (
        ("absent.ply", "no such file"),
        ("damaged.ply", "holds no surface"),
        ("mesh.glb", r"must end in one of \.ply"),
    ):
        with pytest.raises(DatasetError, match=message):
            read_surface(tmp_path / name)
