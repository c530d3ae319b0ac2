# SPDX-License-Identifier: Apache-2.0
"""A folder of images as a sequence."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from hypothesis import given
from hypothesis import strategies as st
from sequences import CAMERA, depth_raw, image_rgb, imread, make_sevenscenes, make_tum, write_image

from slamdepth.datasets import Dataset, known_readers, open_dataset, write_camera
from slamdepth.datasets.readers.images import FolderSequence, ImagesReader
from slamdepth.datasets.resizing import LONGEST_SIDE_PX, reduced_camera
from slamdepth.errors import CameraError, DatasetError, InputError
from slamdepth.io import read_tum_trajectory
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.types import Camera

NAMES = ("frame-2.png", "frame-10.png", "frame-1.png")


def folder_of(folder: Path, names: tuple[str, ...] = NAMES, camera: Camera | None = CAMERA) -> Path:
    for seed, name in enumerate(names):
        write_image(folder / name, image_rgb(seed))
    if camera is not None:
        write_camera(folder / "camera.yaml", camera)
    return folder


def test_images_come_in_natural_order_at_the_rate_of_the_camera_file(tmp_path: Path) -> None:
    camera = Camera(16, 12, 20.0, 21.0, 7.5, 5.5, fps=4.0)
    dataset = open_dataset(folder_of(tmp_path / "walk", camera=camera))
    assert isinstance(dataset, Dataset)
    assert isinstance(dataset, FolderSequence)
    assert (dataset.name, len(dataset), dataset.has_depth, dataset.ground_truth) == ("walk", 3, False, None)
    assert dataset.camera == camera
    assert [path.name for path in dataset.image_paths] == ["frame-1.png", "frame-2.png", "frame-10.png"]
    assert dataset.timestamps_s.tolist() == [0.0, 0.25, 0.5]
    assert dataset.notes == [
        "times are counted: 3 images in the order of their names, frame-1.png to frame-10.png, 4 a second "
        "(fps of the camera file, 30 where it says none)"
    ]
    for index, seed in enumerate((2, 0, 1)):
        frame = dataset.read(index, with_depth=True)
        np.testing.assert_array_equal(frame.image_rgb, image_rgb(seed))
        assert (frame.index, frame.timestamp_s, frame.depth_m) == (index, 0.25 * index, None)
    with pytest.raises(IndexError, match="frame 3 of 3"):
        dataset.read(3)


def test_a_run_folder_is_not_taken_as_images(tmp_path: Path) -> None:
    folder_of(tmp_path, ("mesh.png",), None)
    for name in ("report.json", "trajectory_online.txt", "config.yaml"):
        open_dataset(tmp_path)
        (tmp_path / name).write_text("")
    with pytest.raises(DatasetError, match="is the folder of a run, not a recording"):
        open_dataset(tmp_path)


def test_a_named_camera_file_overrules_the_one_inside(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "walk")
    write_camera(tmp_path / "own.yaml", Camera(16, 12, 30.0, 30.0, 7.5, 5.5))
    assert open_dataset(folder, tmp_path / "own.yaml").camera.fx == 30.0


def test_large_images_are_reduced_with_their_camera_as_those_of_a_video(tmp_path: Path) -> None:
    large = np.full((720, 1280, 3), 90, np.uint8)
    write_image(tmp_path / "0.jpg", large)
    write_image(tmp_path / "1.jpg", large[:, :640])
    write_camera(tmp_path / "camera.yaml", Camera(1280, 720, 1000.0, 1000.0, 639.5, 359.5))
    dataset = open_dataset(tmp_path)
    assert (dataset.camera.width, dataset.camera.height, dataset.camera.fx) == (640, 360, 500.0)
    assert dataset.read(0).image_rgb.shape == (360, 640, 3)
    assert dataset.notes[-1] == "frames of 1280x720 are reduced to 640x360 pixels"
    with pytest.raises(CameraError, match=r"1\.jpg: the image is 640x720, the camera says 1280x720"):
        dataset.read(1)


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_reduced_cameras_fit_and_keep_their_view(width: int, height: int) -> None:
    notes: list[str] = []
    camera = Camera(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
    small = reduced_camera(camera, notes)
    assert max(small.width, small.height) == min(LONGEST_SIDE_PX, max(width, height))
    assert min(small.width, small.height) >= 1
    assert small.fx / small.width == pytest.approx(1.0)
    assert small.cx == pytest.approx((small.width - 1) / 2)
    assert bool(notes) == (small != camera)


def test_the_same_images_elsewhere_are_the_same_sequence(tmp_path: Path) -> None:
    here, there = open_dataset(folder_of(tmp_path / "a")), open_dataset(folder_of(tmp_path / "b"))
    assert sequence_id(here) == sequence_id(there)
    more = open_dataset(folder_of(tmp_path / "c", (*NAMES, "frame-3.png")))
    assert sequence_id(more) != sequence_id(here)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (("0.png", "0.jpg"), r"0\.(png|jpg) and 0\.(png|jpg) are one image or an image and its depth"),
        (("0.jpg", "sub/1.jpg", "0.JPEG"), "are one image or"),
    ],
)
def test_two_images_of_one_name_are_refused(tmp_path: Path, names: tuple[str, ...], says: str) -> None:
    folder_of(tmp_path, names)
    with pytest.raises(DatasetError, match=says):
        open_dataset(tmp_path)


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    unknown = folder_of(tmp_path / "unknown", camera=None)
    write_camera(tmp_path / "other.yaml", Camera(32, 24, 30.0, 30.0, 15.5, 11.5))
    with pytest.raises(CameraError, match=r"frame-1.png: the image is 16x12, the camera says 32x24"):
        open_dataset(unknown, tmp_path / "other.yaml")
    damaged = folder_of(tmp_path / "damaged")
    for path in damaged.glob("*.png"):
        path.write_bytes(b"none")
    with pytest.raises(DatasetError, match="none of the 3 images decodes"):
        open_dataset(damaged)
    write_image(tmp_path / "depth" / "0.png", depth_raw(0))
    with pytest.raises(DatasetError, match=r"0\.png: has 16 bits of grey, as depth images have"):
        open_dataset(tmp_path / "depth")


def test_other_folders_are_not_taken(tmp_path: Path) -> None:
    reader = ImagesReader()
    assert reader.name not in [known.name for known in known_readers()]
    (tmp_path / "empty").mkdir()
    pairs = folder_of(tmp_path / "pairs", ("00000.jpg", "00000.png"))
    (pairs / "camera.json").write_text("{}")
    said = {
        tmp_path / "empty": "is empty; name a video",
        pairs: r"no known sequence layout: .* docs/inputs\.md",
    }
    for folder, message in said.items():
        assert not reader.matches(folder)
        with pytest.raises(DatasetError, match=message) as told:
            open_dataset(folder)
        assert len(str(told.value)) < 150 + len(str(folder))
    assert not isinstance(open_dataset(make_tum(tmp_path / "tum")), FolderSequence)
    assert not isinstance(open_dataset(make_sevenscenes(tmp_path / "seq-01")), FolderSequence)


def test_one_image_is_told_what_it_is_good_for(tmp_path: Path) -> None:
    write_image(tmp_path / "one.png", image_rgb(0))
    with pytest.raises(DatasetError, match=r"one\.png: is one image; .* 'slamdepth depth'"):
        open_dataset(tmp_path / "one.png")


def test_a_folder_of_nothing_but_videos_says_to_name_one(tmp_path: Path) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"holds 1 video: name one, such as '.*walk\.mp4'"):
        open_dataset(tmp_path)
    for name in ("camera.yaml", "groundtruth.txt"):  # of the video: no TUM folder
        (tmp_path / name).write_text("")
    with pytest.raises(DatasetError, match=r"such as '.*walk\.mp4' with --camera '.*camera\.yaml'"):
        open_dataset(tmp_path)


@given(st.lists(st.binary(max_size=40), min_size=1, max_size=3))
def test_garbage_is_refused(tmp_path_factory: pytest.TempPathFactory, contents: list[bytes]) -> None:
    folder = tmp_path_factory.mktemp("garbage")
    for number, content in enumerate(contents):
        (folder / f"{number}.png").write_bytes(content)
    with pytest.raises(InputError):
        open_dataset(folder)


@pytest.mark.data
def test_the_kitchen_s_images_alone(data_dir: Path, tmp_path: Path) -> None:
    kitchen = data_dir / "7scenes_redkitchen_seq-01"
    paths = sorted(kitchen.glob("frame-*.color.*"))[:30]
    folder = tmp_path / "kitchen"
    folder.mkdir()
    for number, path in enumerate(paths):
        cv2.imwrite(str(folder / f"{number}.png"), imread(path))
    write_camera(folder / "camera.yaml", Camera(640, 480, 585.0, 585.0, 320.0, 240.0))
    done = call("run", folder, "--no-mesh", "-q", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    trajectory, _ = read_tum_trajectory(tmp_path / "out" / "trajectory.txt")
    assert len(trajectory) >= 28
