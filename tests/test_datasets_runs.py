# SPDX-License-Identifier: Apache-2.0
"""Videos and folders of images are tracked like the sequence they were made from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import call, images
from sequences import imread
from test_datasets_video import write_video
from tracking_scene import register_constant_depth

from slamdepth.geometry import rotation_angle_rad
from slamdepth.io import read_tum_trajectory, write_camera
from slamdepth.types import Camera

FRAMES = 20


@pytest.fixture(scope="module", autouse=True)
def constant_depth() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        register_constant_depth(monkeypatch)
        yield


@pytest.fixture(scope="module")
def camera_file(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "phone.yaml"
    write_camera(path, Camera.from_file(tiny_room / "camera.yaml"))
    return path


@pytest.fixture(scope="module")
def expected(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Rotations ``(FRAMES, 3, 3)`` of the listed sequence; without depth, its unit of length is open."""
    rotations = tracked(tiny_room, tmp_path_factory.mktemp("listed") / "out")
    assert rotation_angle_rad(rotations).max() > 0.1
    return rotations


def tracked(sequence: Path, output: Path, *more: object) -> np.ndarray:
    done = call(
        "run", sequence, "--depth", "constant", "--max-frames", FRAMES, "--no-mesh", "-q", "-o", output, *more
    )
    assert done.returncode == 0, done.stderr
    trajectory, _ = read_tum_trajectory(output / "trajectory.txt")
    assert len(trajectory) == FRAMES
    return trajectory.T_world_camera[:, :3, :3]


def difference_rad(a: np.ndarray, b: np.ndarray) -> float:
    return float(rotation_angle_rad(np.swapaxes(a, 1, 2) @ b).max())


def test_a_video_is_run_like_its_frames(
    tiny_room: Path, tmp_path: Path, camera_file: Path, expected: np.ndarray
) -> None:
    """Compression leaves the trajectory of the video about that of its images."""
    frames = [imread(path) for path in images(tiny_room)[:FRAMES]]
    video = write_video(tmp_path / "room.avi", frames, Camera.from_file(camera_file).fps)
    assert difference_rad(tracked(video, tmp_path / "out", "--camera", camera_file), expected) < 0.02
    refused = call("run", video, "--depth", "sensor", "--camera", camera_file)
    assert refused.returncode == 2
    assert "has no sensor depth" in refused.stderr


def test_a_folder_of_images_is_run_like_its_sequence(
    tiny_room: Path, tmp_path: Path, camera_file: Path, expected: np.ndarray
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number, path in enumerate(images(tiny_room)):
        (folder / f"frame-{number + 1}.png").hardlink_to(path)
    assert difference_rad(tracked(folder, tmp_path / "out", "--camera", camera_file), expected) < 0.003
    assert "times are counted: 40 images" in (tmp_path / "out" / "report.json").read_text()
