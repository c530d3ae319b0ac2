# SPDX-License-Identifier: Apache-2.0
"""The synthetic room: depth, poses, colours and reproducibility."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from slamdepth.datasets.registry import open_dataset
from slamdepth.errors import ConfigError, OutputError
from slamdepth.geometry import backproject, invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.synth import sequence as synth_sequence
from slamdepth.synth.render import Renderer
from slamdepth.synth.scene import ROOM_M
from slamdepth.synth.sequence import (
    SynthSettings,
    make_renderer,
    render_frame,
    render_frames,
    render_sequence,
    synth_camera,
    synth_trajectory,
)
from slamdepth.types import Camera

CLEAN = SynthSettings(frames=20, width=160, height=120, noise=0, lighting_variation=0)
SMALL = SynthSettings(frames=4, width=64, height=48, seed=2)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return make_renderer(CLEAN)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_sequence(tmp_path_factory.mktemp("synth") / "room", SMALL)


def pixel_grid(camera: Camera) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(float)


def test_depth_is_that_of_the_ceiling(renderer: Renderer) -> None:
    """Looking up, tilted: along z, through integer pixel centres, to float precision."""
    camera = synth_camera(CLEAN)
    T_world_camera = se3_exp(np.array([1.3, 1.2, 1.0, 0.10, -0.15, 0.3]))  # z up: towards the ceiling
    depth = renderer.depth(T_world_camera).ravel()
    rays = backproject(camera, pixel_grid(camera), np.ones(len(depth))) @ T_world_camera[:3, :3].T
    expected = (ROOM_M[2] - 1.0) / rays[:, 2]
    points = T_world_camera[:3, 3] + expected[:, None] * rays
    free = (np.abs(points[:, :2] - [2.5, 2.0]).max(axis=1) > 0.6) & (points[:, :2].min(axis=1) > 0.5)
    assert free.sum() > 5000
    np.testing.assert_allclose(depth[free], expected[free], rtol=2e-6)


def test_all_points_lie_in_the_room_and_many_on_its_walls(renderer: Renderer) -> None:
    camera = synth_camera(CLEAN)
    for index in (0, 7, 13):
        frame, T_world_camera = render_frame(renderer, CLEAN, index)
        assert frame.depth_m is not None
        points_c = backproject(camera, pixel_grid(camera), frame.depth_m.ravel().astype(float))
        points = transform(T_world_camera, points_c)
        assert (points > -1e-4).all()
        assert (points < np.array(ROOM_M) + 1e-4).all()
        on_wall = (np.abs(points) < 1e-4) | (np.abs(points - ROOM_M) < 1e-4)
        assert on_wall.any(axis=1).mean() > 0.1


def reprojection_errors(renderer: Renderer, camera: Camera, i: int, j: int) -> tuple[float, float]:
    """Median relative depth error and median grey level error of frame i seen in frame j."""
    (first, T_world_i), (second, T_world_j) = (render_frame(renderer, CLEAN, k) for k in (i, j))
    assert first.depth_m is not None
    assert second.depth_m is not None
    points_i = backproject(camera, pixel_grid(camera), first.depth_m.ravel().astype(float))
    pixels, z = project(camera, transform(invert(T_world_j) @ T_world_i, points_i))
    u, v = pixels.astype(np.float32).T
    inside = (z > 0) & (u > 1) & (v > 1) & (u < camera.width - 2) & (v < camera.height - 2)
    seen = cv2.remap(second.depth_m, u[None], v[None], cv2.INTER_LINEAR)[0]
    grey = [cv2.cvtColor(f.image_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) for f in (first, second)]
    there = cv2.remap(grey[1], u[None], v[None], cv2.INTER_LINEAR)[0]
    visible = inside & (np.abs(seen - z) < 0.05 * z)
    assert visible.mean() > 0.4
    return (
        float(np.median(np.abs(seen - z)[visible] / z[visible])),
        float(np.median(np.abs(there - grey[0].ravel())[visible])),
    )


def test_one_frame_reprojects_into_another(renderer: Renderer) -> None:
    camera = synth_camera(CLEAN)
    depth_error, grey_error = reprojection_errors(renderer, camera, 5, 8)
    assert depth_error < 2e-4
    assert grey_error < 4.0


def test_intrinsics_wrong_by_half_a_pixel_are_noticed(renderer: Renderer) -> None:
    right = synth_camera(CLEAN)
    wrong = Camera(right.width, right.height, right.fx, right.fy, right.cx + 0.5, right.cy + 0.5)
    assert reprojection_errors(renderer, wrong, 5, 8)[0] > 5 * reprojection_errors(renderer, right, 5, 8)[0]


def test_the_loop_closes_and_moves_like_a_hand() -> None:
    for frames in (300, 600, 900):
        settings = SynthSettings(frames=frames)
        T = synth_trajectory(settings).T_world_camera
        np.testing.assert_allclose(T[0], T[-1], atol=1e-9)
        np.testing.assert_allclose(T @ invert(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
        speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) * settings.fps
        turn = np.degrees(rotation_angle_rad(invert(T[:-1, :, :])[:, :3, :3] @ T[1:, :3, :3])) * settings.fps
        assert 0.15 < speed.mean() < 0.4
        assert speed.max() < 0.5
        assert turn.max() < 30


def test_first_and_last_frame_show_the_same(renderer: Renderer) -> None:
    first, last = (render_frame(renderer, CLEAN, k)[0] for k in (0, CLEAN.frames - 1))
    np.testing.assert_allclose(first.image_rgb.astype(int), last.image_rgb.astype(int), atol=2)


def test_same_settings_same_bytes(tmp_path: Path, sequence: Path) -> None:
    calls: list[tuple[int, int]] = []
    again = render_sequence(tmp_path / "again", SMALL, lambda *call: calls.append(call))
    files = sorted(p.relative_to(sequence) for p in sequence.rglob("*") if p.is_file())
    assert len(files) == 2 * SMALL.frames + 5
    assert all((sequence / f).read_bytes() == (again / f).read_bytes() for f in files)
    assert calls == [(k, 4) for k in range(1, 5)]


def test_another_seed_is_another_room(sequence: Path) -> None:
    other, _ = next(render_frames(SMALL.model_copy(update={"seed": 1}), [0]))
    images = [open_dataset(sequence).read(0).image_rgb, other.image_rgb]
    assert np.abs(np.diff(np.stack(images).astype(int), axis=0)).mean() > 5


def test_the_files_hold_the_rendered_frames(sequence: Path) -> None:
    dataset = open_dataset(sequence)
    assert len(dataset) == SMALL.frames
    assert dataset.camera == synth_camera(SMALL)
    assert dataset.ground_truth is not None
    exact = synth_trajectory(SMALL)
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera, exact.T_world_camera, atol=1e-8)
    np.testing.assert_array_equal(dataset.timestamps_s, exact.timestamps_s)
    for index, (frame, _) in zip((0, 2), render_frames(SMALL, (0, 2)), strict=True):
        read = dataset.read(index, with_depth=True)
        np.testing.assert_array_equal(read.image_rgb, frame.image_rgb)
        assert read.depth_m is not None
        assert frame.depth_m is not None
        np.testing.assert_allclose(read.depth_m, frame.depth_m, atol=1.01e-4)


def test_an_interrupted_rendering_resumes(
    tmp_path: Path, sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(synth_sequence, "make_renderer", functools.cache(make_renderer))  # built once

    class Stop(Exception):
        pass

    def stop_after_two(done: int, total: int) -> None:
        if done == 2:
            raise Stop

    with pytest.raises(Stop):
        render_sequence(tmp_path / "cut", SMALL, stop_after_two)
    cut = tmp_path / "cut"
    assert not (cut / "rgb.txt").exists()  # lists come last, so half a sequence is not readable
    kept = sorted((cut / "rgb").iterdir())
    stamps = [p.stat().st_mtime_ns for p in kept]
    assert len(kept) == 2
    render_sequence(cut, SMALL)
    assert [p.stat().st_mtime_ns for p in kept] == stamps
    for file in (p for p in sequence.rglob("*") if p.is_file()):
        assert (cut / file.relative_to(sequence)).read_bytes() == file.read_bytes()


def test_a_folder_with_other_content_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        render_sequence(tmp_path, SMALL)
    begun = tmp_path / "begun"
    begun.mkdir()
    (begun / "synth.yaml").write_text(yaml.safe_dump({"scene_version": 0, "frames": 9}))
    with pytest.raises(OutputError, match="other settings"):
        render_sequence(begun, SMALL)
    with pytest.raises(OutputError, match="is a file"):
        render_sequence(tmp_path / "notes.txt", SMALL)
    with pytest.raises(OutputError):
        render_sequence(tmp_path / "notes.txt" / "below", SMALL)


def test_noise_blur_light_and_texture_have_their_effect(renderer: Renderer) -> None:
    clean, _ = render_frame(renderer, CLEAN, 4)
    pixels = clean.image_rgb.astype(float)

    noisy, _ = render_frame(renderer, CLEAN.model_copy(update={"noise": 4.0}), 4)
    middle = (pixels > 20) & (pixels < 235)
    assert np.std((noisy.image_rgb - pixels)[middle]) == pytest.approx(4.0, rel=0.05)

    lit = CLEAN.model_copy(update={"lighting_variation": 0.5})
    means = [
        [render_frame(renderer, settings, k)[0].image_rgb.mean() for k in (0, 6, 12, 18)]
        for settings in (lit, CLEAN)
    ]
    gains = np.divide(means[0], means[1])
    assert max(gains) / min(gains) > 1.05

    # A slow frame rate, so that the camera moves visibly in half a frame's time.
    slow = CLEAN.model_copy(update={"fps": 2.0})
    blurred, _ = render_frame(renderer, slow.model_copy(update={"motion_blur": 5}), 4)
    sharp, _ = render_frame(renderer, slow, 4)
    edges = [np.abs(np.diff(f.image_rgb.astype(float), axis=1)).mean() for f in (blurred, sharp)]
    assert edges[0] < 0.9 * edges[1]
    np.testing.assert_array_equal(blurred.depth_m, sharp.depth_m)

    rough, _ = render_frame(renderer, CLEAN.model_copy(update={"depth_noise": 0.0014}), 4)
    assert clean.depth_m is not None
    assert rough.depth_m is not None
    relative = (rough.depth_m - clean.depth_m) / clean.depth_m**2
    assert np.std(relative) == pytest.approx(0.0014, rel=0.05)

    faint, _ = next(render_frames(CLEAN.model_copy(update={"texture": "low"}), [4]))
    steps = [np.median(np.abs(np.diff(f.image_rgb.astype(float), axis=1))) for f in (faint, clean)]
    assert steps[0] < 0.6 * steps[1]


def test_a_bare_room_has_shape_but_few_corners(renderer: Renderer) -> None:
    bare, _ = next(render_frames(CLEAN.model_copy(update={"texture": "bare"}), [3]))
    fast = cv2.FastFeatureDetector.create(15)
    corners = [
        len(fast.detect(cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)))
        for frame in (bare, render_frame(renderer, CLEAN, 3)[0])
    ]
    assert 0 < corners[0] < 0.25 * corners[1]
    assert bare.depth_m is not None
    assert np.ptp(bare.depth_m) > 0.5


def test_images_have_many_corners(renderer: Renderer) -> None:
    grey = cv2.cvtColor(render_frame(renderer, CLEAN, 3)[0].image_rgb, cv2.COLOR_RGB2GRAY)
    assert len(cv2.FastFeatureDetector.create(15).detect(grey)) > 250
    assert 70 < grey.mean() < 190


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigError, match="unknown setting 'colour'; allowed here: depth_noise, fps"):
        SynthSettings.from_dict({"colour": "blue"})
    with pytest.raises(ConfigError, match="'frames'"):
        SynthSettings.from_dict({"frames": 0})
    assert SynthSettings.from_dict({"frames": 3}).frames == 3
