# SPDX-License-Identifier: Apache-2.0
"""The aliased hall: workstations that are alike, exact truth, and a path that comes back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from slamdepth.cli.app import app
from slamdepth.datasets.registry import open_dataset
from slamdepth.geometry import backproject, invert, rotation_angle_rad, transform
from slamdepth.synth.aliased import HEIGHT_M, NORTH_M, Hall, build_aliased_scene
from slamdepth.synth.path import look
from slamdepth.synth.render import Renderer
from slamdepth.synth.sequence import (
    SynthSettings,
    make_renderer,
    render_frame,
    render_sequence,
    synth_camera,
    synth_trajectory,
)

CLEAN = SynthSettings(
    frames=360, width=160, height=120, noise=0, lighting_variation=0, scene="aliased", seed=1
)
SMALL = SynthSettings(frames=3, width=64, height=48, scene="aliased", seed=2)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return make_renderer(CLEAN)


def looking_north(x: float) -> np.ndarray:
    """A camera in the hall at ``x`` that sees one bay and no end wall."""
    T = look(np.array([[x, 1.2, 1.45]]), np.radians([90.0]), np.radians([-12.0]), np.zeros(1))
    return np.asarray(T[0])


def test_one_workstation_looks_exactly_like_the_next(renderer: Renderer) -> None:
    centres = Hall.of(CLEAN.seed).centres_m
    first, *others = (renderer.render(looking_north(x)) for x in centres[2:6])
    assert np.ptp(first[0]) > 150
    for colour, depth in others:
        # Single pixels of silhouettes may fall on either side.
        assert np.quantile(np.abs(depth - first[1]), 0.995) < 1e-4
        assert np.quantile(np.abs(colour - first[0]), 0.98) < 1.0


def test_the_surfaces_of_two_bays_differ_by_a_translation_only() -> None:
    hall = Hall.of(CLEAN.seed)
    of_id: dict[str, list[np.ndarray]] = {}
    for surface in build_aliased_scene(CLEAN.seed, "rich").surfaces:
        if surface.texture_id is not None:
            of_id.setdefault(surface.texture_id, []).append(surface.points)
    assert len(of_id) > 100
    for points in of_id.values():
        assert len(points) == hall.bays
        offsets = np.sort([(p - points[0])[0, 0, 0] for p in points])
        np.testing.assert_allclose(np.diff(offsets), hall.spacing_m, atol=1e-12)
        for p in points:
            np.testing.assert_allclose(np.ptp(p - points[0], axis=(0, 1)), 0.0, atol=1e-12)


def test_the_end_walls_tell_the_ends_apart(renderer: Renderer) -> None:
    centres = Hall.of(CLEAN.seed).centres_m
    first, last, middle = (renderer.render(looking_north(centres[k]))[0] for k in (0, -1, 2))
    for end in (first, last):
        assert np.abs(end - middle).mean() > 1.0
    assert np.abs(first - last).mean() > 1.0


def test_depth_and_poses_place_every_point_inside_the_hall(renderer: Renderer) -> None:
    camera, hall = synth_camera(CLEAN), Hall.of(CLEAN.seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    low, high = np.array([0.0, hall.south_m, 0.0]), np.array([hall.length_m, NORTH_M, HEIGHT_M])
    for index in (0, 100, 250):
        frame, T_world_camera = render_frame(renderer, CLEAN, index)
        assert frame.depth_m is not None
        points = transform(T_world_camera, backproject(camera, pixels, frame.depth_m.ravel().astype(float)))
        assert (points > low - 1e-4).all()
        assert (points < high + 1e-4).all()
        assert (np.abs(points[:, 1] - NORTH_M) < 1e-4).mean() > 0.1
        assert (np.abs(points[:, 2]) < 1e-4).mean() > 0.02


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("frames", [240, 600])
def test_the_path_passes_workstations_comes_back_and_moves_like_a_hand(seed: int, frames: int) -> None:
    settings = SynthSettings(frames=frames, scene="aliased", seed=seed)
    T, hall = synth_trajectory(settings).T_world_camera, Hall.of(seed)
    np.testing.assert_allclose(T[0], T[-1], atol=1e-9)
    speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) * settings.fps
    turn = np.degrees(rotation_angle_rad((invert(T[:-1]) @ T[1:])[:, :3, :3])) * settings.fps
    assert 0.5 < speed.mean() < 1.2
    assert speed.max() < 1.5
    assert turn.max() < (35 if frames == 240 else 75)
    x = T[:, 0, 3]
    assert x.min() > 0.9
    assert x.max() < hall.length_m - 0.9
    bays = np.floor(x / hall.spacing_m).astype(int)
    visits = bays[np.flatnonzero(np.diff(bays, prepend=-1))]
    assert len(set(visits)) >= (2 if frames == 240 else 3)
    assert len(visits) > len(set(visits))  # at least one is seen again


def test_very_short_paths_close_too() -> None:
    for frames in (2, 20, 60):
        T = synth_trajectory(SynthSettings(frames=frames, scene="aliased")).T_world_camera
        np.testing.assert_allclose(T[0], T[-1], atol=1e-9)
        assert np.isfinite(T).all()


def test_seeds_differ_in_number_spacing_and_path() -> None:
    halls = [Hall.of(seed) for seed in range(10)]
    assert len({hall.bays for hall in halls}) >= 3
    assert len({hall.spacing_m for hall in halls}) >= 8
    assert {hall.has_north_doors for hall in halls} == {True, False}


def test_the_files_are_the_same_each_time_and_hold_the_truth(tmp_path: Path) -> None:
    one, other = (render_sequence(tmp_path / name, SMALL) for name in ("one", "other"))
    files = sorted(p.relative_to(one) for p in one.rglob("*") if p.is_file())
    assert len(files) == 2 * SMALL.frames + 5
    assert all((one / f).read_bytes() == (other / f).read_bytes() for f in files)
    dataset = open_dataset(one)
    assert dataset.has_depth
    assert dataset.ground_truth is not None
    exact = synth_trajectory(SMALL).T_world_camera
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera, exact, atol=1e-8)
    assert yaml.safe_load((one / "synth.yaml").read_text())["scene"] == "aliased"


def test_a_room_is_recorded_as_before_there_were_other_scenes(tmp_path: Path) -> None:
    render_sequence(tmp_path / "room", SMALL.model_copy(update={"scene": "room", "frames": 2}))
    assert "scene" not in yaml.safe_load((tmp_path / "room" / "synth.yaml").read_text())


def test_the_command_line_renders_the_hall_and_names_wrong_scenes(tmp_path: Path) -> None:
    size = ["--frames", "2", "--width", "64", "--height", "48"]
    done = CliRunner().invoke(app, ["synth", str(tmp_path / "hall"), "--scene", "aliased", *size])
    assert done.exit_code == 0
    assert len(open_dataset(tmp_path / "hall")) == 2
    assert "--scene aliased" in CliRunner().invoke(app, ["synth", "--help"]).output
    wrong = CliRunner().invoke(app, ["synth", str(tmp_path / "x"), "--scene", "cave", *size])
    assert wrong.exit_code != 0
    assert not (tmp_path / "x").exists()
