# SPDX-License-Identifier: Apache-2.0
"""The 7-Scenes layout, and the registry that finds it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sequences import depth_raw, image_rgb, make_sevenscenes, poses, write_image

from slamdepth.datasets import Dataset, known_readers, open_dataset, register_reader, write_camera
from slamdepth.datasets.poses import read_pose
from slamdepth.datasets.readers.tum import TumReader
from slamdepth.errors import CameraError, DatasetError
from slamdepth.types import Camera

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60
)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_reads_a_whole_folder(tmp_path: Path, ending: str) -> None:
    dataset = open_dataset(make_sevenscenes(tmp_path / "seq-01", ending=ending))
    assert isinstance(dataset, Dataset)
    assert (dataset.name, len(dataset), dataset.has_depth) == ("seq-01", 3, True)
    assert (dataset.camera.fx, dataset.camera.cx, dataset.camera.depth_factor) == (585.0, 320.0, 1000.0)
    assert len(dataset.notes) == 1
    assert "known by the 7-Scenes layout" in dataset.notes[0]
    np.testing.assert_allclose(dataset.timestamps_s, [0, 1 / 30, 2 / 30], rtol=0, atol=1e-15)
    assert dataset.ground_truth is not None
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera, poses(3), atol=1e-12)
    frame = dataset.read(1, with_depth=True)
    assert frame.depth_m is not None
    assert frame.depth_m[0, 0] == frame.depth_m[0, 1] == 0.0
    assert frame.depth_m[1, 1] == np.float32(1.001)
    assert (frame.image_rgb == 10).all()


def test_frames_keep_their_number_as_time(tmp_path: Path) -> None:
    folder = make_sevenscenes(tmp_path)
    for path in folder.glob("frame-000001.*"):
        path.unlink()
    dataset = open_dataset(folder)
    np.testing.assert_allclose(dataset.timestamps_s, [0, 2 / 30], rtol=0, atol=1e-15)


@pytest.mark.parametrize("value", ["nan", "-inf", "0"])
def test_lost_poses_are_dropped_with_a_count(tmp_path: Path, value: str) -> None:
    folder = make_sevenscenes(tmp_path)
    (folder / "frame-000001.pose.txt").write_text((" ".join([value] * 4) + "\n") * 4)
    (folder / "frame-000002.pose.txt").unlink()
    dataset = open_dataset(folder)
    assert dataset.ground_truth is not None
    assert dataset.ground_truth.timestamps_s.tolist() == [0.0]
    assert "1 invalid poses (NaN, infinity, no rotation) dropped from the ground truth" in dataset.notes
    assert "1 of 3 frames have no pose.txt" in dataset.notes


def test_depth_and_poses_are_optional(tmp_path: Path) -> None:
    folder = make_sevenscenes(tmp_path)
    for path in [*folder.glob("*.depth.png"), *folder.glob("*.pose.txt")]:
        path.unlink()
    dataset = open_dataset(folder)
    assert (dataset.has_depth, dataset.ground_truth, len(dataset.notes)) == (False, None, 1)


def test_malformed_poses_name_file_and_line(tmp_path: Path) -> None:
    folder = make_sevenscenes(tmp_path)
    path = folder / "frame-000001.pose.txt"
    for text, where in (
        ("1 0 0 0\n0 1 0\n", "pose.txt:2: expected 4 lines of 4 numbers"),
        ("1 0 0 0\n0 1 0 x\n", "pose.txt:2: expected"),
        ("1 0 0 0\n" * 5, "pose.txt:5: expected"),
        ("1 0 0 0\n" * 3, "pose.txt:3: expected 4 lines of 4 numbers, the file has 3"),
        ("", "pose.txt:1: expected 4 lines of 4 numbers, the file has 0"),
    ):
        path.write_text(text)
        with pytest.raises(DatasetError) as caught:
            open_dataset(folder)
        assert where in str(caught.value)


@RELAXED
@given(
    st.one_of(
        st.binary(max_size=100),
        st.lists(st.floats(), min_size=16, max_size=16).map(
            lambda v: "\n".join(" ".join(map(repr, v[i : i + 4])) for i in range(0, 16, 4)).encode()
        ),
    )
)
def test_garbage_poses_are_rigid_lost_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "frame-000000.pose.txt"
    path.write_bytes(data)
    try:
        T = read_pose(path)
    except DatasetError:
        return
    assert T is None or np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_mirror_is_no_pose(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "p.txt", np.diag([1.0, -1.0, 1.0, 1.0]))
    assert read_pose(tmp_path / "p.txt") is None


def test_camera_file_keeps_millimetres(tmp_path: Path) -> None:
    folder = make_sevenscenes(tmp_path / "seq")
    write_camera(folder / "camera.yaml", Camera(640, 480, 525.0, 525.0, 320.0, 240.0))
    dataset = open_dataset(folder)
    assert (dataset.camera.fx, dataset.camera.depth_factor) == (525.0, 1000.0)
    assert dataset.notes == ["depth factor 1000 by the 7-Scenes layout, not the 5000 of the camera file"]


def test_other_sizes_and_missing_colour_are_errors(tmp_path: Path) -> None:
    write_image(tmp_path / "a" / "frame-000000.color.png", image_rgb(0))
    with pytest.raises(CameraError, match="the image is 16x12, the camera says 640x480"):
        open_dataset(tmp_path / "a")
    write_image(tmp_path / "b" / "frame-000000.depth.png", depth_raw(0))
    with pytest.raises(DatasetError, match=r"no colour images; expected frame-NNNNNN\.color"):
        open_dataset(tmp_path / "b")


@pytest.mark.data
def test_real_kitchen(data_dir: Path) -> None:
    dataset = open_dataset(data_dir / "7scenes_redkitchen_seq-01")
    assert (len(dataset), dataset.has_depth) == (300, True)
    assert dataset.ground_truth is not None
    assert len(dataset.ground_truth) == 300
    T = dataset.ground_truth.T_world_camera[0]
    np.testing.assert_allclose(T[:3, 3], [-0.34045634, 0.01646982, 0.29656917], atol=1e-8)
    np.testing.assert_allclose(T[0, :3], [0.9093129, 0.27262229, -0.31422433], atol=1e-4)
    depth_m = dataset.read(0, with_depth=True).depth_m
    assert depth_m is not None
    assert depth_m[depth_m > 0].min() > 0.3
    assert depth_m.max() < 10.0


# The registry


def test_readers_are_found_and_named_once() -> None:
    names = [reader.name for reader in known_readers()]
    assert {"7scenes", "tum", "video"} <= set(names)
    assert names == sorted(set(names))
    assert all(reader.needs for reader in known_readers())

    class Twice(TumReader):
        pass

    with pytest.raises(ValueError, match="two dataset readers are named 'tum'"):
        register_reader(Twice)


def test_importing_the_package_imports_no_reader() -> None:
    import subprocess
    import sys

    code = "import sys, slamdepth.datasets; print([m for m in sys.modules if 'readers' in m or m == 'cv2'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# What is of no layout


@pytest.mark.parametrize(
    "name", ["frame-0001.png", "frame-000001.jpg", "frame-rate.txt", "frame-1.colour.png"]
)
def test_the_images_of_a_video_are_not_7_scenes(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"")
    assert not any(reader.matches(tmp_path) for reader in known_readers())


@pytest.mark.parametrize(
    "name", ["frame-000000.color.jpg", "frame-000000.depth.png", "frame-000000.pose.txt"]
)
def test_any_file_of_7_scenes_tells_the_layout(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"")
    assert [reader.name for reader in known_readers() if reader.matches(tmp_path)] == ["7scenes"]
