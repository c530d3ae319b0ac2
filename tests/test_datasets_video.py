# SPDX-License-Identifier: Apache-2.0
"""A video as a sequence."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamdepth.datasets import Dataset, open_dataset, write_camera
from slamdepth.datasets.intrinsics import Certainty
from slamdepth.datasets.readers.video import VideoSequence
from slamdepth.datasets.video import VideoFile
from slamdepth.errors import CameraError, DatasetError
from slamdepth.types import Camera

COUNT = 12


def write_video(path: Path, images_bgr: list[np.ndarray], fps: float = 10.0) -> Path:
    size = (images_bgr[0].shape[1], images_bgr[0].shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for image in images_bgr:
        writer.write(image)
    writer.release()
    return path


def grey_video(path: Path, width: int = 64, height: int = 48) -> Path:
    return write_video(path, [np.full((height, width, 3), 20 * n, np.uint8) for n in range(COUNT)])


def camera_file(path: Path, width: int = 64, height: int = 48) -> Path:
    write_camera(path, Camera(width, height, 0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2))
    return path


def opened(folder: Path, width: int = 64, height: int = 48) -> VideoSequence:
    dataset = open_dataset(
        grey_video(folder / "walk.mp4", width, height), camera_file(folder / "phone.yaml", width, height)
    )
    assert isinstance(dataset, VideoSequence)
    return dataset


def test_a_video_is_a_sequence_without_depth_and_truth(tmp_path: Path) -> None:
    dataset = opened(tmp_path)
    assert isinstance(dataset, Dataset)
    assert (dataset.name, len(dataset), dataset.has_depth, dataset.ground_truth) == (
        "walk",
        COUNT,
        False,
        None,
    )
    assert dataset.notes == []
    assert dataset.camera.fps == 10.0
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(COUNT) / 10, atol=1e-9)


def test_frames_may_be_read_in_any_order_and_by_several_threads(tmp_path: Path) -> None:
    dataset = opened(tmp_path)
    order = [3, 4, 9, 2, 2, 0, COUNT - 1, 5]
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(lambda n: dataset.read(n, with_depth=True), order))
    for n, frame in zip(order, frames, strict=True):
        assert (frame.index, frame.timestamp_s, frame.depth_m) == (n, dataset.timestamps_s[n], None)
        assert abs(float(frame.image_rgb.mean()) - 20 * n) < 4
    with pytest.raises(IndexError, match=f"frame {COUNT} of {COUNT}"):
        dataset.read(COUNT)


@pytest.mark.parametrize(("width", "height", "reduced"), [(1280, 720, (640, 360)), (720, 1280, (360, 640))])
def test_large_frames_are_reduced_with_their_camera(
    tmp_path: Path, width: int, height: int, reduced: tuple[int, int]
) -> None:
    dataset = opened(tmp_path, width, height)
    assert (dataset.camera.width, dataset.camera.height) == reduced
    assert dataset.camera.fx == pytest.approx(0.9 * width / 2)
    assert dataset.camera.cx == pytest.approx((reduced[0] - 1) / 2)
    assert dataset.read(1).image_rgb.shape == (reduced[1], reduced[0], 3)
    assert dataset.notes == [f"frames of {width}x{height} are reduced to {reduced[0]}x{reduced[1]} pixels"]


def test_a_video_has_its_own_camera_alone(tmp_path: Path) -> None:
    video = grey_video(tmp_path / "walk.mp4")
    camera_file(tmp_path / "camera.yaml")  # of whatever else lies there
    assert open_dataset(video).camera_source.certainty is Certainty.GUESSED
    with pytest.raises(CameraError, match="the image is 64x48, the camera says 128x96"):
        open_dataset(video, camera_file(tmp_path / "other.yaml", 128, 96))


def test_what_is_no_video(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"absent.mp4: no such video file"):
        open_dataset(tmp_path / "absent.mp4")
    damaged = tmp_path / "walk.mp4"
    damaged.write_bytes(b"no video")
    with pytest.raises(DatasetError, match="no video that can be read"):
        open_dataset(damaged, camera_file(tmp_path / "phone.yaml"))
    text = tmp_path / "walk.txt"
    text.write_text("a walk", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"is a file; a sequence is a folder or a video \(mp4, "):
        open_dataset(text)


@pytest.mark.parametrize(
    ("times_ms", "camera_fps", "expected_s", "note"),
    [
        ([40.0, 73.0, 140.0], None, [0.0, 0.033, 0.1], ""),  # a phone's, at no equal intervals
        ([40.0, 73.0, 140.0], 20.0, [0.0, 0.033, 0.1], ""),
        ([0.0, 0.0, 0.0], None, [0.0, 0.1, 0.2], "are all the same; 10 Hz (as the video names) is assumed"),
        ([0.0, 50.0, 40.0], None, [0.0, 0.1, 0.2], "do not increase; 10 Hz (as the video names) is"),
        ([0.0, 0.0, 0.0], 20.0, [0.0, 0.05, 0.1], "all the same; 20 Hz (fps of the camera file) is assumed"),
        ([0.0, 50.0, 40.0], 20.0, [0.0, 0.05, 0.1], "not increase; 20 Hz (fps of the camera file) is"),
    ],
)
def test_each_frame_says_its_own_time(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    times_ms: list[float],
    camera_fps: float | None,
    expected_s: list[float],
    note: str,
) -> None:
    class Capture:
        def __init__(self) -> None:
            self.at = -1

        def grab(self) -> bool:
            self.at += 1
            return self.at < len(times_ms)

        def get(self, what: int) -> float:
            assert what == cv2.CAP_PROP_POS_MSEC
            return times_ms[self.at]

        def release(self) -> None:
            pass

    video = VideoFile(grey_video(tmp_path / "walk.mp4"))
    monkeypatch.setattr(video, "_open", Capture)
    np.testing.assert_allclose(video.timestamps_s(camera_fps), expected_s)
    assert [note in one for one in video.notes] == [True] * bool(note)


def test_fps_of_the_camera_file_replaces_useless_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_camera(tmp_path / "phone.yaml", Camera(64, 48, 60.0, 60.0, 31.5, 23.5, fps=4.0))
    video = grey_video(tmp_path / "walk.mp4")
    monkeypatch.setattr(cv2, "CAP_PROP_POS_MSEC", cv2.CAP_PROP_ORIENTATION_META)  # is 0 for each frame
    dataset = open_dataset(video, tmp_path / "phone.yaml")
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(COUNT) / 4)
    assert dataset.camera.fps == 4.0
    assert "4 Hz (fps of the camera file) is assumed" in dataset.notes[0]


def noisy_video(path: Path, codec: str, count: int = 30) -> Path:
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, (64, 48))
    for _ in range(count):
        writer.write(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("ending", "codec"), [("avi", "MJPG"), ("mkv", "MJPG"), ("mp4", "mp4v"), ("mov", "mp4v")]
)
def test_a_whole_video_promises_what_it_holds(tmp_path: Path, ending: str, codec: str) -> None:
    video = noisy_video(tmp_path / f"walk.{ending}", codec)
    dataset = open_dataset(video, camera_file(tmp_path / "phone.yaml"))
    assert isinstance(dataset, VideoSequence)
    assert (len(dataset), dataset.frames_promised, dataset.notes) == (30, 30, [])


def damaged(data: bytes) -> bytes:
    third, gap = len(data) // 3, len(data) // 4
    return data[:third] + bytes(gap) + data[third + gap :]


@pytest.mark.parametrize(
    ("ending", "codec", "harm"),
    [
        ("avi", "MJPG", lambda data: data[: len(data) // 2]),
        ("mkv", "MJPG", lambda data: data[: len(data) // 2]),
        ("avi", "MJPG", damaged),
        ("mkv", "MJPG", damaged),
        ("mp4", "mp4v", damaged),
    ],
)
def test_frames_that_are_missing_are_counted(
    tmp_path: Path, ending: str, codec: str, harm: Callable[[bytes], bytes]
) -> None:
    video = noisy_video(tmp_path / f"walk.{ending}", codec)
    video.write_bytes(harm(video.read_bytes()))
    dataset = open_dataset(video, camera_file(tmp_path / "phone.yaml"))
    assert isinstance(dataset, VideoSequence)
    assert dataset.frames_promised == 30
    assert 0 < len(dataset) < 29
    missing = 30 - len(dataset)
    assert dataset.notes == [
        f"the video promises 30 frames, {len(dataset)} can be read: {missing} are missing; it was cut short "
        "or is damaged"
    ]


def test_an_estimated_number_of_frames_is_no_promise(tmp_path: Path) -> None:
    video = VideoFile(grey_video(tmp_path / "walk.mp4"))
    video.path, video.frames_named = tmp_path / "walk.webm", 100
    assert "88 are missing" in video.missing_note(12, np.arange(12) / 10)
    assert video.missing_note(12, np.arange(12) / 3) == ""  # of a phone that slowed down in the dark
    assert video.missing_note(12) == ""
    video.frames_named = 13
    assert video.missing_note(12, np.arange(12) / 10) == ""
