# SPDX-License-Identifier: Apache-2.0
"""The TUM layout: what a whole folder gives, and one clear error for each way it can be broken."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sequences import CAMERA, depth_raw, image_rgb, make_tum, write_image

import slamdepth.datasets
from slamdepth.datasets import Dataset, associate, open_dataset, write_camera
from slamdepth.datasets.readers.tum import TumReader, known_camera, read_image_list
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError
from slamdepth.types import Camera

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=80
)


def error_of(folder: Path, kind: type[Exception] = DatasetError, camera: Path | None = None) -> str:
    with pytest.raises(kind) as caught:
        open_dataset(folder, camera)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_all_names_exist() -> None:
    assert slamdepth.datasets.__all__ == sorted(slamdepth.datasets.__all__)
    assert all(hasattr(slamdepth.datasets, name) for name in slamdepth.datasets.__all__)


# A whole folder


def test_reads_a_whole_folder(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path / "seq"))
    assert isinstance(dataset, Dataset)
    assert (dataset.name, len(dataset), dataset.has_depth, dataset.notes) == ("seq", 4, True, [])
    assert dataset.camera == CAMERA
    np.testing.assert_allclose(dataset.timestamps_s, [10.0, 10.1, 10.2, 10.3], rtol=0, atol=1e-9)
    assert dataset.ground_truth is not None
    np.testing.assert_array_equal(dataset.ground_truth.T_world_camera[:, 0, 3], [0, 1, 2, 3])

    frame = dataset.read(2)
    assert (frame.index, frame.timestamp_s, frame.depth_m) == (2, 10.2, None)
    np.testing.assert_array_equal(frame.image_rgb, image_rgb(2))
    depth_m = dataset.read(2, with_depth=True).depth_m
    assert depth_m is not None
    np.testing.assert_allclose(depth_m, depth_raw(2) / 5000.0, rtol=1e-7)
    for index in (-1, 4):
        with pytest.raises(IndexError):
            dataset.read(index)


def test_threads_read_the_same(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path))
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(lambda i: dataset.read(i % 4, with_depth=True), range(64)))
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image_rgb, image_rgb(i % 4))


def test_colour_alone_is_enough(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "depth.txt").unlink()
    (folder / "groundtruth.txt").unlink()
    dataset = open_dataset(folder)
    assert not dataset.has_depth
    assert dataset.ground_truth is None
    assert dataset.read(0, with_depth=True).depth_m is None


def test_depth_is_paired_by_time_one_to_one(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    # 10.005 suits the first image, 10.21 and 10.195 the third (10.195 better), none the others.
    (folder / "depth.txt").write_text(
        "10.005 depth/0.png\n10.15 depth/1.png\n10.195 depth/2.png\n10.21 depth/3.png\n"
    )
    dataset = open_dataset(folder)
    depths = [dataset.read(i, with_depth=True).depth_m for i in range(4)]
    assert [depth is None for depth in depths] == [False, True, False, True]
    assert depths[2] is not None
    np.testing.assert_allclose(depths[2], depth_raw(2) / 5000.0, rtol=1e-7)
    assert dataset.notes == ["depth.txt: 2 of 4 colour images have no depth image within 0.02 s"]


def test_lists_with_tabs_commas_crlf_and_a_byte_order_mark(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "rgb.txt").write_bytes(
        "﻿# c\r\ntimestamp,filename\r\n\r\n10.0\trgb/0.png\r\n10.1,rgb/1.png \r\n10.2   rgb/a b.png".encode()
    )
    write_image(folder / "rgb" / "a b.png", image_rgb(9))
    dataset = open_dataset(folder)
    assert len(dataset) == 3
    np.testing.assert_array_equal(dataset.read(2).image_rgb, image_rgb(9))


def test_an_empty_depth_list_is_refused(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "depth.txt").write_text("# nothing\n")
    assert error_of(folder).endswith("depth.txt: lists no images; expected 'timestamp filename' a line")


# Intrinsics


def test_camera_file_overrules_the_folders(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "seq")
    other = Camera(16, 12, 99.0, 99.0, 8.0, 6.0, depth_factor=1000.0)
    write_camera(tmp_path / "other.yaml", other)
    dataset = open_dataset(folder, tmp_path / "other.yaml")
    assert dataset.camera == other
    depth_m = dataset.read(0, with_depth=True).depth_m
    assert depth_m is not None
    np.testing.assert_allclose(depth_m, depth_raw(0) / 1000.0, rtol=1e-7)
    assert "none.yaml: cannot be read" in error_of(folder, CameraError, tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("name", "fx"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.306408),
        ("rgbd_dataset_freiburg2_xyz", 520.908620),
        ("rgbd_dataset_freiburg3_long_office_household", 535.4),
        ("fr1_desk", 517.306408),
        ("FR3-office", 535.4),
        ("freiburg2", 520.908620),
        ("my_fr3", 535.4),
        ("freiburg4_desk", None),
        ("fr10_desk", None),
        ("afr1_desk", None),
        ("frog1", None),
        ("room", None),
    ],
)
def test_tum_cameras_are_known_by_name(name: str, fx: float | None) -> None:
    camera = known_camera(name)
    assert (camera and camera.fx) == fx
    if camera:
        assert (camera.width, camera.height, camera.depth_factor) == (640, 480, 5000.0)


def test_named_camera_is_noted_and_checked(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg2_x"
    write_image(folder / "rgb" / "0.jpg", np.zeros((480, 640, 3), np.uint8))
    (folder / "rgb.txt").write_text("1.0 rgb/0.jpg\n")
    dataset = open_dataset(folder)
    assert len(dataset.notes) == 1
    assert "freiburg2_x" in dataset.notes[0]
    assert "5208" in dataset.notes[0]
    make_tum(tmp_path / "rgbd_dataset_freiburg1_x", camera_file=False)
    message = error_of(tmp_path / "rgbd_dataset_freiburg1_x", CameraError)
    assert "0.png: the image is 16x12, the camera says 640x480; if the images were resized" in message


# Bad input


def test_folders_that_are_none(tmp_path: Path) -> None:
    assert error_of(tmp_path / "none") == f"{tmp_path / 'none'}: no such folder"
    (tmp_path / "file").write_text("")
    assert "is a file" in error_of(tmp_path / "file")
    message = error_of(tmp_path)
    assert "no known sequence layout" in message
    assert "docs/inputs.md" in message


def test_missing_list(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "rgb.txt").unlink()
    assert "rgb.txt: missing" in error_of(folder)
    for image in (folder / "rgb").iterdir():
        image.unlink()
    assert "rgb.txt: missing" in error_of(folder)  # depth.txt tells the layout


def test_images_in_rgb_without_any_list(tmp_path: Path) -> None:
    write_image(tmp_path / "rgb" / "0.png", image_rgb(0))
    message = error_of(tmp_path)
    assert "rgb.txt: missing; write a line 'seconds rgb/NAME' for each image in " in message
    assert "README" in message


def test_photos_with_a_folder_rgb_are_not_tum(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    assert not TumReader().matches(tmp_path)
    write_image(tmp_path / "photo.jpg", image_rgb(0))
    write_image(tmp_path / "rgb" / "0.png", image_rgb(0))
    assert not TumReader().matches(tmp_path)
    (tmp_path / "photo.jpg").unlink()
    assert TumReader().matches(tmp_path)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", "rgb.txt: lists no images"),
        ("# only\n\n", "rgb.txt: lists no images"),
        ("# c\n10.0 rgb/0.png\n10.1\n", "rgb.txt:3: expected 'timestamp filename', found '10.1'"),
        ("ten rgb/0.png\n", "rgb.txt:1: expected"),
        ("nan rgb/0.png\n", "rgb.txt:1: expected"),
        ("10.0 rgb/0.png\n10.0 rgb/1.png\n", "rgb.txt:2: time 10.0 does not come after 10.000000"),
        ("10.0 rgb/0.png\n\n9.0 rgb/1.png\n", "rgb.txt:3: time 9.0 does not come after"),
        ("10.0 rgb/x.png\n10.1 rgb/y.png\n", "none of its 2 images exists; the first is"),
        ("10.0 " + "x" * 5000 + "\n", "none of its 1 images exists"),
        ("10.0 a\0b\n", "none of its 1 images exists"),
    ],
)
@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_malformed_lists(tmp_path: Path, name: str, text: str, where: str) -> None:
    folder = make_tum(tmp_path)
    (folder / name).write_text(text)
    assert where.replace("rgb.txt", name) in error_of(folder)


def test_some_missing_images_are_noted_and_raise_when_read(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "rgb" / "0.png").unlink()
    (folder / "depth" / "1.png").unlink()
    dataset = open_dataset(folder)
    assert dataset.notes[:2] == [
        "rgb.txt: 1 of 4 images do not exist",
        "depth.txt: 1 of 4 images do not exist",
    ]
    with pytest.raises(ImageDecodeError, match=r"0\.png: cannot be read: No such file"):
        dataset.read(0)
    assert dataset.read(1, with_depth=True).depth_m is None


def test_damaged_images_raise_when_read(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    (folder / "rgb" / "0.png").write_bytes(b"")
    (folder / "depth" / "2.png").write_bytes(b"no image")
    dataset = open_dataset(folder)
    with pytest.raises(ImageDecodeError, match=r"0\.png: the image is empty"):
        dataset.read(0, with_depth=True)
    dataset.read(2)
    with pytest.raises(ImageDecodeError, match=r"depth/2\.png: the image does not decode"):
        dataset.read(2, with_depth=True)


def test_no_image_decodes(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    for image in (folder / "rgb").iterdir():
        image.write_bytes(b"")
    assert "none of the 4 images decodes" in error_of(folder)


def test_sizes_that_differ(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    larger = Camera(20, 10, 20.0, 20.0, 10.0, 5.0)
    write_image(folder / "rgb" / "1.png", image_rgb(1, larger))
    write_image(folder / "depth" / "2.png", depth_raw(1, larger))
    dataset = open_dataset(folder)
    with pytest.raises(CameraError, match=r"rgb/1\.png: the image is 20x10, the camera says 16x12"):
        dataset.read(1)
    with pytest.raises(CameraError, match=r"depth/2\.png: the image is 20x10"):
        dataset.read(2, with_depth=True)
    write_image(folder / "rgb" / "0.png", image_rgb(1, larger))
    assert "0.png: the image is 20x10" in error_of(folder, CameraError)


def test_ground_truth_is_repaired_with_notes_or_refused(tmp_path: Path) -> None:
    folder = make_tum(tmp_path)
    path = folder / "groundtruth.txt"
    path.write_text("10 0 0 0 0 0 0 1\n10.1 nan 0 0 0 0 0 1\n10.2 0 0 0 0 0 0 0\n10.3 0 0 0 0 0 0 1\n")
    dataset = open_dataset(folder)
    assert dataset.ground_truth is not None
    assert len(dataset.ground_truth) == 2
    assert dataset.notes == ["groundtruth.txt: 2 rows with NaN, infinity or a zero quaternion dropped"]
    path.write_text("10 0 0 0 0 0 0\n")
    assert "groundtruth.txt:1: expected eight numbers" in error_of(folder)
    path.write_text("10.1 0 0 0 0 0 0 1\n10 0 0 0 0 0 0 1\n")
    assert "groundtruth.txt:2: time 10.0 comes after 10.1" in error_of(folder)
    path.write_text("99 0 0 0 0 0 0 1\n")
    message = error_of(folder)
    assert "images from 10.000 to 10.300 s, ground truth from 99.000 to 99.000 s" in message


# Properties


@RELAXED
@given(
    data=st.one_of(st.binary(max_size=120), st.text(max_size=120).map(lambda t: t.encode("utf-8", "replace")))
)
def test_garbage_lists_are_read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "rgb.txt"
    path.write_bytes(data)
    try:
        times, images = read_image_list(path)
    except DatasetError:
        return
    assert len(times.texts) == len(images)
    assert (np.diff(times.values) > 0).all()


@RELAXED
@given(
    times=st.lists(st.integers(0, 10**9), min_size=1, max_size=10, unique=True).map(sorted),
    bad=st.text(
        st.characters(exclude_categories=["Z", "C"], exclude_characters=","), min_size=1, max_size=20
    ),
)
def test_lists_round_trip_and_name_the_bad_line(tmp_path: Path, times: list[int], bad: str) -> None:
    path = tmp_path / "rgb.txt"
    text = "".join(f"{time / 1000:.6f} rgb/{time}.png\n" for time in times)
    path.write_text(text)
    written, images = read_image_list(path)
    np.testing.assert_allclose(written.values, np.array(times) / 1000, rtol=0, atol=1e-9)
    assert [image.name for image in images] == [f"{time}.png" for time in times]
    path.write_text(text + "x" + bad + "\n", encoding="utf-8")
    with pytest.raises(DatasetError, match=f"rgb.txt:{len(times) + 1}: expected 'timestamp filename'"):
        read_image_list(path)


def greedy(first: list[float], second: list[float], limit: float) -> list[tuple[int, int]]:
    """The definition, by brute force."""
    candidates = sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second))
    pairs: list[tuple[int, int]] = []
    for difference, i, j in candidates:
        if difference < limit and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return sorted(pairs)


times_lists = st.lists(st.integers(0, 300), max_size=25, unique=True).map(
    lambda v: [t / 128 for t in sorted(v)]
)


@RELAXED
@given(first=times_lists, second=times_lists, limit=st.sampled_from([0.0, 1 / 128, 0.02, 0.5]))
def test_association_is_greedy_by_difference(first: list[float], second: list[float], limit: float) -> None:
    assert associate(np.array(first), np.array(second), limit) == greedy(first, second, limit)


# Real data


@pytest.mark.data
def test_real_rpy(data_dir: Path) -> None:
    dataset = open_dataset(data_dir / "rgbd_dataset_freiburg1_rpy")
    assert (len(dataset), dataset.has_depth) == (723, True)
    assert dataset.ground_truth is not None
    assert len(dataset.ground_truth) == 2742
    frame = dataset.read(100, with_depth=True)
    assert frame.depth_m is not None
    known = frame.depth_m[frame.depth_m > 0]
    assert 0.4 < np.median(known) < 3.0
    assert known.size > 0.4 * frame.depth_m.size


@pytest.mark.data
def test_real_desk_has_no_depth(data_dir: Path) -> None:
    dataset = open_dataset(data_dir / "rgbd_dataset_freiburg1_desk")
    assert (len(dataset), dataset.has_depth) == (613, False)
    assert dataset.camera.fx == 517.306408
    assert dataset.read(612).image_rgb.shape == (480, 640, 3)
