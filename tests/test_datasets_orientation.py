# SPDX-License-Identifier: Apache-2.0
"""Images and videos stored on their side are turned upright, and their camera and depth with them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from sequences import CAMERA, depth_raw, image_rgb, make_tum, write_image

from slamdepth.calibration import WideLens
from slamdepth.datasets import open_dataset, write_camera
from slamdepth.datasets.image_files import read_image_frame
from slamdepth.datasets.orientation import _AXES, exif_orientation, turned_camera, turned_image
from slamdepth.errors import CameraError
from slamdepth.pipeline.depth_maps.sources import open_source
from slamdepth.types import Camera

DISTORTED = Camera(16, 12, 20.0, 21.0, 7.1, 5.9, (0.05, -0.02, 0.003, -0.004, 0.01))
TO_STORED = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""The orientation that undoes each."""
ON_ITS_SIDE = (5, 6, 7, 8)


def write_stored(path: Path, upright_rgb: np.ndarray, orientation: int) -> Path:
    """Write a PNG whose pixels are stored so that ``orientation`` makes ``upright_rgb`` of them."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(turned_image(upright_rgb, TO_STORED[orientation])).save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_wide_lens_turns_with_its_images(orientation: int) -> None:
    lens = WideLens("unified", (1.2, -0.1, 0.02, 0.003, -0.004))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    stored = lens.project(np.column_stack([points, np.ones(50)]))
    turned = turned_camera(Camera(16, 12, 20.0, 20.0, 7.1, 5.9, lens=lens), orientation)
    axes = np.array(_AXES[orientation], float)
    assert turned.lens is not None
    found = turned.lens.project(np.column_stack([points @ axes.T, np.ones(50)]))
    np.testing.assert_allclose(found, stored @ axes.T, atol=1e-12)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_camera_sees_each_point_where_the_turned_image_shows_it(orientation: int) -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    points[:, 2] += 1.0
    stored_px, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), DISTORTED.K, DISTORTED.distortion_array
    )
    numbers = np.arange(16 * 12, dtype=np.int32).reshape(12, 16)
    turned = turned_camera(DISTORTED, orientation)
    upright = turned_image(numbers, orientation)
    assert upright.shape == (turned.height, turned.width)
    # The three-dimensional scene turns as the pixel axes do.
    rows, columns = (np.argwhere(upright == numbers[v, u])[0] for v, u in ((5, 7), (5, 8)))
    along_x = (columns - rows)[::-1]
    down = np.argwhere(upright == numbers[6, 7])[0]
    along_y = (down - rows)[::-1]
    axes = np.column_stack([along_x, along_y])
    moved = points.copy()
    moved[:, :2] = points[:, :2] @ axes.T
    found_px, _ = cv2.projectPoints(moved, np.zeros(3), np.zeros(3), turned.K, turned.distortion_array)
    expected_px = (stored_px[:, 0] - [7.0, 5.0]) @ axes.T + rows[::-1]
    np.testing.assert_allclose(found_px[:, 0], expected_px, atol=1e-9)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_of_every_orientation_are_upright_everywhere(tmp_path: Path, orientation: int) -> None:
    for number in range(3):
        write_stored(tmp_path / f"images/{number}.png", image_rgb(number), orientation)
    path = tmp_path / "images/1.png"
    assert exif_orientation(path) == orientation
    for camera in {CAMERA, turned_camera(CAMERA, TO_STORED[orientation])}:
        camera_file = tmp_path / "camera.yaml"
        write_camera(camera_file, camera)
        dataset = open_dataset(tmp_path / "images", camera_file)
        assert dataset.camera == CAMERA
        np.testing.assert_array_equal(dataset.read(1).image_rgb, image_rgb(1))
        is_noted = dataset.notes[0].startswith("images are turned upright, as their EXIF says")
        assert is_noted == (orientation != 1)
        frame, _ = read_image_frame(path, 1, (camera, "a file"))
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.image_rgb, image_rgb(1))
    frame, _ = read_image_frame(path, 1, None)
    np.testing.assert_array_equal(frame.image_rgb, image_rgb(1))


@pytest.mark.parametrize(
    ("orientation", "depth_is_upright"),
    [*((n, False) for n in range(1, 9)), *((n, True) for n in ON_ITS_SIDE)],
)
def test_depth_turns_with_its_image(tmp_path: Path, orientation: int, depth_is_upright: bool) -> None:
    folder = make_tum(tmp_path)
    for number in range(4):
        write_stored(folder / f"rgb/{number}.png", image_rgb(number), orientation)
        stored = (
            depth_raw(number) if depth_is_upright else turned_image(depth_raw(number), TO_STORED[orientation])
        )
        write_image(folder / f"depth/{number}.png", stored)
    frame = open_dataset(folder).read(2, with_depth=True)
    np.testing.assert_array_equal(frame.image_rgb, image_rgb(2))
    assert frame.depth_m is not None
    np.testing.assert_array_equal(frame.depth_m, depth_raw(2) / np.float32(5000.0))


def test_a_turned_camera_without_exif_is_refused_with_a_hint(tmp_path: Path) -> None:
    write_image(tmp_path / "0.png", image_rgb(0))
    write_camera(tmp_path / "camera.yaml", turned_camera(CAMERA, 6))
    with pytest.raises(CameraError, match="16x12, the camera says 12x16; one lies on its side"):
        open_dataset(tmp_path)
    write_camera(tmp_path / "camera.yaml", CAMERA.scaled(32, 24))
    with pytest.raises(CameraError, match=r"multiply fx, fy, cx, cy by 0\.5 and write their size"):
        open_dataset(tmp_path)


def rotated_video(path: Path, rotation_deg: int, stored_rgb: list[np.ndarray]) -> Path:
    """An mp4 whose header says how far a player turns it clockwise."""
    height, width = stored_rgb[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height))
    for image in stored_rgb:
        writer.write(image[..., ::-1])
    writer.release()
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 44  # the matrix of a track header of version 0
    cos, sin = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[rotation_deg]
    data[start : start + 36] = struct.pack(
        ">9i", cos << 16, sin << 16, 0, -sin << 16, cos << 16, 0, 0, 0, 1 << 30
    )
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(("rotation_deg", "orientation"), [(0, 1), (90, 6), (180, 3), (270, 8)])
def test_a_camera_of_either_size_fits_a_turned_video(
    tmp_path: Path, rotation_deg: int, orientation: int
) -> None:
    upright = np.zeros((48, 64, 3), np.uint8)
    upright[:16, :16] = 255
    stored = turned_image(upright, TO_STORED[orientation])
    video = rotated_video(tmp_path / "walk.mp4", rotation_deg, [stored] * 3)
    own = Camera(64, 48, 60.0, 60.0, 30.0, 24.0)
    write_camera(tmp_path / "upright.yaml", own)
    dataset = open_dataset(video, tmp_path / "upright.yaml")
    assert dataset.notes == []
    assert np.abs(dataset.read(0).image_rgb.astype(int) - upright).mean() < 3
    write_camera(tmp_path / "stored.yaml", turned_camera(own, TO_STORED[orientation]))
    turned = open_dataset(video, tmp_path / "stored.yaml")
    source = open_source(
        video,
        camera_file=tmp_path / "stored.yaml",
        stride=1,
        max_frames=None,
    )
    if orientation in ON_ITS_SIDE:
        assert turned.camera == dataset.camera
        assert turned.notes == [
            "the camera of 48x64 pixels is that of the images as they are stored, and is turned with them"
        ]
        assert source.camera == own
