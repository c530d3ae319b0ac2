# SPDX-License-Identifier: Apache-2.0
"""Images of wide lenses come back as a pinhole camera renders the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from wide_world import LENSES, depth_through_lens, render_pair, source_camera, through_lens, wide_camera

import slamdepth
from slamdepth.calibration import WideLens
from slamdepth.datasets import Dataset, open_dataset, write_camera
from slamdepth.datasets.image_files import read_image_frame
from slamdepth.datasets.virtual_view import ViewedSequence, VirtualView, as_pinhole, pinhole_of
from slamdepth.errors import CameraError
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.synth.sequence import SynthSettings
from slamdepth.types import Camera, Frame
from slamdepth.typing import Bytes

SIDE = 160


def pattern(camera: Camera) -> Bytes:
    """What a pinhole camera sees of a wall of smooth waves at one metre, ``(H, W, 3)``."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    waves = [np.sin(9 * x + y), np.sin(8 * y - x), np.sin(6 * x) * np.sin(7 * y)]
    return np.asarray(np.round(127 + 120 * np.stack(waves, axis=2)), np.uint8)


@pytest.mark.parametrize("lens", LENSES.values(), ids=lambda lens: lens.model)
def test_a_view_is_what_the_pinhole_camera_renders(lens: WideLens) -> None:
    camera = wide_camera(SIDE, lens, 2.0)
    source = source_camera(camera)
    view = VirtualView(camera)
    assert view.has_source.all()
    assert view.camera.lens is None
    seen = view.render(through_lens(pattern(source), source, camera)).astype(float)
    error = np.abs(seen - pattern(view.camera))[2:-2, 2:-2]
    assert np.median(error) < 1.5
    assert error.max() < 16  # edges, where few pixels show waves


@pytest.mark.parametrize("lens", LENSES.values(), ids=lambda lens: lens.model)
def test_depth_along_z_stays(lens: WideLens) -> None:
    camera = wide_camera(SIDE, lens, 2.0)
    source = source_camera(camera)
    u = np.arange(source.width, dtype=np.float32)
    slanted = np.broadcast_to(2.0 + (u - source.cx) / source.fx * 0.3, (source.height, source.width))
    view = VirtualView(camera)
    depth = view.render_depth(depth_through_lens(np.ascontiguousarray(slanted, np.float32), source, camera))
    expected = 2.0 + (np.arange(view.camera.width) - view.camera.cx) / view.camera.fx * 0.3
    assert np.abs(depth - expected)[2:-2, 2:-2].max() < 0.3 * 3.0 / view.camera.fx


@pytest.mark.parametrize("side", [160, 1600])
def test_the_centre_keeps_its_resolution_up_to_the_longest_side(side: int) -> None:
    camera = wide_camera(side)
    view = VirtualView(camera)
    assert view.camera.fx == pytest.approx(min(camera.fx, view.camera.fx))
    assert max(view.camera.width, view.camera.height) <= 640
    half = np.degrees(np.arctan(view.camera.width / 2 / view.camera.fx))
    assert half == pytest.approx(50.0, abs=0.5)
    rays = view.camera.fx * np.tan(np.radians([-50.0, 50.0])) + view.camera.cx
    assert rays == pytest.approx([-0.5, view.camera.width - 0.5], abs=1.0)
    assert view.camera.fy / view.camera.fx == pytest.approx(camera.fy / camera.fx)


def test_a_large_image_is_averaged_not_sampled() -> None:
    camera = wide_camera(1600)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (1600, 1600, 3), dtype=np.uint8)
    view = VirtualView(camera)
    middle = view.render(noise)[300:340, 300:340]
    assert middle.std() < 0.7 * noise.std()


def test_a_narrow_lens_keeps_what_fits_a_rectangle() -> None:
    """A telephoto lens by a fisheye model: nearly all of the image, and nothing outside of it."""
    camera = Camera(640, 480, 800.0, 800.0, 300.0, 240.0, lens=LENSES["fisheye"])
    view = VirtualView(camera)
    assert view.has_source.all()
    assert view.camera.width == 640
    assert view.camera.height >= 460
    degrees = np.degrees(np.arctan((view.camera.cx + 0.5) / view.camera.fx))
    assert degrees == pytest.approx(np.degrees(300.5 / 800.0), abs=0.3)


def test_a_lens_that_ends_within_the_image_ends_the_view() -> None:
    lens = WideLens("fisheye", (-0.4, 0.0, 0.0, 0.0))
    camera = Camera(640, 640, 200.0, 200.0, 319.5, 319.5, lens=lens)
    view = VirtualView(camera)
    corner = np.array([[view.camera.cx / view.camera.fx, view.camera.cy / view.camera.fy, 1.0]])
    assert np.isfinite(lens.project(corner)).all()
    assert view.has_source.all()


def test_images_of_another_size_are_refused() -> None:
    view = VirtualView(wide_camera(SIDE))
    with pytest.raises(CameraError, match="the image is 80x60, the camera says 160x160"):
        view.render(np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(CameraError, match="the image is 80x60"):
        view.render_depth(np.zeros((60, 80), np.float32))
    with pytest.raises(CameraError, match="needs no virtual view"):
        VirtualView(view.camera)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """One walk through a wide lens, and as the pinhole camera of its view renders it."""
    camera = wide_camera(256)
    settings = SynthSettings(frames=24, width=320, height=240, seed=3, fps=240.0)
    return render_pair(settings, camera, pinhole_of(camera), tmp_path_factory.mktemp("walk"))


def test_frames_of_a_sequence_are_views(walk: tuple[Path, Path]) -> None:
    wide, pinhole = (open_dataset(path) for path in walk)
    assert isinstance(wide, ViewedSequence)
    assert isinstance(wide, Dataset)
    assert wide.has_depth
    assert wide.name == "wide"
    assert wide.camera_source == wide.raw.camera_source
    assert wide.camera == pinhole.camera
    assert wide.notes[-1].startswith(
        "images of 256x256 through a lens of the model 'fisheye' are undistorted"
    )
    assert len(wide) == len(pinhole) == 24
    assert wide.ground_truth is not None
    one, other = (dataset.read(3, with_depth=True) for dataset in (wide, pinhole))
    assert one.depth_m is not None
    assert other.depth_m is not None
    assert np.median(np.abs(one.image_rgb.astype(float) - other.image_rgb)) <= 4
    assert np.median(np.abs(one.depth_m - other.depth_m)) < 0.01
    assert sequence_id(wide) == sequence_id(wide.raw)


def test_a_run_through_a_wide_lens_is_as_exact_as_through_a_pinhole(walk: tuple[Path, Path]) -> None:
    errors = []
    for path in walk:
        dataset = open_dataset(path)
        with slamdepth.Tracker(dataset.camera, depth_model=slamdepth.create_depth_model("sensor")) as tracker:
            for frame in dataset:
                tracker.step(frame)
            found = tracker.finish().trajectory
        assert dataset.ground_truth is not None
        errors.append(slamdepth.score_trajectory(dataset.ground_truth, found).sim3.rmse_m)
    assert errors[0] < 0.01
    assert errors[0] < 2.0 * errors[1] + 0.002


def test_a_video_and_a_folder_of_a_wide_lens_are_views(tmp_path: Path, walk: tuple[Path, Path]) -> None:
    images = sorted((walk[0] / "rgb").iterdir())
    folder = tmp_path / "images"
    folder.mkdir()
    for image in images[:5]:
        (folder / image.name).hardlink_to(image)
    camera_file = walk[0] / "camera.yaml"
    expected = open_dataset(walk[0])
    dataset = open_dataset(folder, camera_file)
    assert dataset.camera.without_distortion() == dataset.camera
    np.testing.assert_array_equal(dataset.read(2).image_rgb, expected.read(2).image_rgb)

    writer = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (256, 256))
    for image in images[:5]:
        writer.write(np.asarray(cv2.imread(str(image)), np.uint8))
    writer.release()
    video = open_dataset(tmp_path / "walk.avi", camera_file)
    assert (video.camera.width, len(video)) == (dataset.camera.width, 5)
    assert video.read(4).image_rgb.shape == dataset.read(4).image_rgb.shape
    frame, found = read_image_frame(images[0], 0, (slamdepth.Camera.from_file(camera_file), "a file"))
    assert frame.camera == found.camera == replace(dataset.camera, fps=frame.camera.fps)


def test_frames_of_a_pinhole_stay_as_they_are() -> None:
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    frame = Frame(0, 0.0, np.zeros((6, 8, 3), np.uint8), camera)
    assert as_pinhole(frame) is frame
    assert pinhole_of(camera) is camera


def test_a_camera_file_of_another_image_size_is_refused(tmp_path: Path, walk: tuple[Path, Path]) -> None:
    write_camera(tmp_path / "other.yaml", wide_camera(300))
    done = call("run", walk[0], "--camera", tmp_path / "other.yaml", "--output", tmp_path / "run")
    assert done.returncode == 2
    assert "the image is 256x256, the camera says 300x300" in done.stderr
