# SPDX-License-Identifier: Apache-2.0
"""Trajectories, images, text and JSON: exact round trips, and one clear error for what is damaged."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from enum import Enum
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sequences import depth_raw, image_rgb, poses, write_image

import slamdepth.io
from slamdepth.errors import DatasetError, ImageDecodeError, InputError, OutputError
from slamdepth.io import (
    TrajectoryWriter,
    format_timestamp,
    read_depth_m,
    read_image_rgb,
    read_lines,
    read_tum_trajectory,
    replacing,
    write_json,
    write_text,
    write_tum_trajectory,
)
from slamdepth.io.image_end import is_cut_short
from slamdepth.io.text import replacing_folder
from slamdepth.types import Trajectory

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60
)
ROW = "0 0 0 0 0 0 1"


def test_all_names_exist() -> None:
    assert slamdepth.io.__all__ == sorted(slamdepth.io.__all__)
    assert all(hasattr(slamdepth.io, name) for name in slamdepth.io.__all__)


# Trajectories: reading


def test_reads_positions_and_xyzw_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    half = np.sqrt(0.5)
    path.write_text(f"# a comment\n\n1.5 1 2 3 0 0 {half} {half}\n")
    trajectory, notes = read_tum_trajectory(path)
    assert notes == []
    assert trajectory.timestamps_s.tolist() == [1.5]
    # A quarter turn about z takes x to y.
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(trajectory.T_world_camera[0], expected, atol=1e-15)
    assert trajectory.T_world_camera.dtype == np.float64


@pytest.mark.parametrize(
    "text",
    ["﻿1 {r}\r\n2 {r}\r\n", "1\t{t}\n2\t{t}\n", "1,{c}\n2,{c}\n", "1 {r}\r2 {r}", "  1   {r}  \n\n#\n2 {r}"],
)
def test_tolerates_editors_and_separators(tmp_path: Path, text: str) -> None:
    path = tmp_path / "t.txt"
    filled = text.format(r=ROW, t=ROW.replace(" ", "\t"), c=ROW.replace(" ", ","))
    path.write_bytes(filled.encode("utf-8"))
    trajectory, _ = read_tum_trajectory(path)
    assert trajectory.timestamps_s.tolist() == [1.0, 2.0]


def test_drops_and_counts_invalid_and_repeated_rows(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text(
        f"1 {ROW}\n2 nan 0 0 0 0 0 1\n3 0 0 0 0 0 0 0\n3 0 -inf 0 0 0 0 1\nnan {ROW}\n"
        f"1 {ROW}\n4 {ROW}\n5 0 0 0 0 0 0 2\n"
    )
    trajectory, notes = read_tum_trajectory(path)
    assert trajectory.timestamps_s.tolist() == [1.0, 4.0, 5.0]
    np.testing.assert_array_equal(trajectory.T_world_camera[-1], np.eye(4))
    assert notes == [
        "t.txt: 4 rows with NaN, infinity or a zero quaternion dropped",
        "t.txt: 1 rows with the time of the row before dropped",
        "t.txt: 1 quaternions whose length is not 1 normalised",
    ]


@pytest.mark.parametrize(
    ("text", "where"),
    [
        (f"# c\n1 {ROW}\n\n2 0 0 0\n", "t.txt:4: expected eight numbers"),
        (f"1 {ROW} 7\n", "t.txt:1: expected eight numbers"),
        ("1 0 0 0 0 0 0 one\n", "t.txt:1: expected eight numbers"),
        ("1 0 0 0 0 0 0 1_0\n", "t.txt:1: expected eight numbers"),
        (f"1 {ROW}\n\x0c\n2 0\n", "t.txt:3: expected eight numbers"),
        (f"2 {ROW}\n1 {ROW}\n", "t.txt:2: time 1.0 comes after 2.0"),
        ("", "holds no valid pose"),
        ("1 nan 0 0 0 0 0 1\n", "holds no valid pose (1 rows"),
    ],
)
def test_names_the_malformed_line(tmp_path: Path, text: str, where: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(DatasetError) as caught:
        read_tum_trajectory(path)
    assert where in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_is_a_dataset_error(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="cannot be read"):
        read_tum_trajectory(tmp_path / "none.txt")


@RELAXED
@given(data=st.binary(max_size=200))
def test_garbage_bytes_are_read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "t.txt"
    path.write_bytes(data)
    try:
        trajectory, _ = read_tum_trajectory(path)
    except DatasetError:
        return
    assert len(trajectory) > 0


@RELAXED
@given(
    good=st.integers(0, 4),
    bad=st.text(st.characters(codec="utf-8", exclude_characters="\r\n"), min_size=1, max_size=60).filter(
        lambda text: text.strip() and not text.strip().startswith("#")
    ),
)
def test_garbage_lines_are_named_by_number(tmp_path: Path, good: int, bad: str) -> None:
    path = tmp_path / "t.txt"
    lines = [f"{i} {ROW}" for i in range(good)] + [bad + " x"]
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(DatasetError, match=f"t.txt:{good + 1}:"):
        read_tum_trajectory(path)


@RELAXED
@given(numbers=st.lists(st.floats(), min_size=8, max_size=8))
def test_any_eight_numbers_give_a_rigid_pose_or_an_error(tmp_path: Path, numbers: list[float]) -> None:
    path = tmp_path / "t.txt"
    path.write_text(" ".join(map(repr, numbers)))
    try:
        trajectory, _ = read_tum_trajectory(path)
    except DatasetError:
        return
    R = trajectory.T_world_camera[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


# Trajectories: writing

finite = st.floats(-1e6, 1e6, allow_subnormal=False)


@RELAXED
@given(
    times=st.lists(st.floats(0, 2e9, allow_subnormal=False), min_size=1, max_size=8, unique=True),
    vectors=st.lists(st.tuples(*[finite] * 6), min_size=8, max_size=8),
)
def test_trajectory_round_trip(tmp_path: Path, times: list[float], vectors: list[tuple[float, ...]]) -> None:
    n = len(times)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec([vector[:3] for vector in vectors[:n]]).as_matrix()
    T[:, :3, 3] = [vector[3:] for vector in vectors[:n]]
    written = Trajectory(np.array(sorted(times)), T)
    write_tum_trajectory(tmp_path / "t.txt", written)
    read, notes = read_tum_trajectory(tmp_path / "t.txt")
    assert notes == []
    np.testing.assert_array_equal(read.timestamps_s, written.timestamps_s)
    np.testing.assert_allclose(read.T_world_camera[:, :3, 3], T[:, :3, 3], rtol=1e-9, atol=0)
    np.testing.assert_allclose(read.T_world_camera[:, :3, :3], T[:, :3, :3], rtol=0, atol=2e-9)


@given(st.floats(-1e12, 1e12))
def test_timestamps_survive_exactly(value: float) -> None:
    text = format_timestamp(value)
    assert float(text) == value
    assert len(text.partition(".")[2]) >= 6


def test_evo_reads_what_is_written(tmp_path: Path) -> None:
    from evo.tools import file_interface

    T = poses(5)
    write_tum_trajectory(tmp_path / "t.txt", Trajectory(np.arange(5) / 30 + 1305031229.5, T))
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(np.array(read.poses_se3), T, atol=1e-8)


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("old")
    T = np.eye(4)[None].copy()
    T[0, 0, 3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        write_tum_trajectory(path, Trajectory(np.zeros(1), T))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["t.txt"]


def test_writer_lines_are_readable_while_it_is_open(tmp_path: Path) -> None:
    path, T = tmp_path / "t.txt", poses(3)
    with TrajectoryWriter(path) as writer:
        for i in range(3):
            writer.append(i / 30, T[i])
            read, _ = read_tum_trajectory(path)
            assert len(read) == i + 1
        with pytest.raises(ValueError, match="must increase"):
            writer.append(2 / 30, T[0])
    writer.close()
    np.testing.assert_allclose(read.T_world_camera, T, atol=1e-8)
    with pytest.raises(ValueError, match="closed"):
        writer.append(9.0, T[0])


def test_a_comment_between_poses_is_skipped_by_readers(tmp_path: Path) -> None:
    from evo.tools import file_interface

    path, T = tmp_path / "t.txt", poses(2)
    with TrajectoryWriter(path) as writer:
        writer.append(0.0, T[0])
        writer.comment("another world frame")
        writer.append(0.1, T[1])
        with pytest.raises(ValueError, match="one line"):
            writer.comment("two\nlines")
    assert path.read_text().splitlines()[2] == "# another world frame"
    assert len(read_tum_trajectory(path)[0]) == 2
    assert file_interface.read_tum_trajectory_file(str(path)).num_poses == 2


def test_writer_survives_kill_9(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    code = (
        "import sys, numpy as np\nfrom slamdepth.io import TrajectoryWriter\n"
        "writer = TrajectoryWriter(sys.argv[1])\n"
        "for i in range(10**9): writer.append(i / 30, np.eye(4))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(path)])
    try:
        while not path.exists() or path.stat().st_size < 10_000:
            assert process.poll() is None
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    trajectory, notes = read_tum_trajectory(path)
    assert notes == []
    assert len(trajectory) > 100
    assert path.read_bytes().endswith(b"\n")


def test_writer_refuses_what_no_reader_would_take(tmp_path: Path) -> None:
    with TrajectoryWriter(tmp_path / "t.txt") as writer:
        with pytest.raises(ValueError, match="finite"):
            writer.append(0.0, np.full((4, 4), np.nan))
        with pytest.raises(ValueError, match="finite"):
            writer.append(0.0, np.eye(3))
    with pytest.raises(OutputError, match="cannot be written"):
        TrajectoryWriter(tmp_path / "none" / "t.txt")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_writer_reports_a_full_disk() -> None:
    with pytest.raises(OutputError, match="/dev/full: cannot be written: No space left"):
        TrajectoryWriter("/dev/full")


# Images


def test_reads_rgb_in_order(tmp_path: Path) -> None:
    image = image_rgb(0)
    write_image(tmp_path / "i.png", image)
    read = read_image_rgb(tmp_path / "i.png")
    assert read.dtype == np.uint8
    np.testing.assert_array_equal(read, image)


def test_grey_images_get_three_channels(tmp_path: Path) -> None:
    grey = image_rgb(0)[..., 0]
    write_image(tmp_path / "i.png", grey)
    np.testing.assert_array_equal(read_image_rgb(tmp_path / "i.png"), np.repeat(grey[..., None], 3, axis=2))


def test_depth_in_metres_with_unknown_values(tmp_path: Path) -> None:
    raw = depth_raw(1)
    raw[0, 0], raw[0, 1] = 0, 65535
    write_image(tmp_path / "d.png", raw)
    depth_m = read_depth_m(tmp_path / "d.png", 1000.0, unknown_raw=(65535,))
    assert depth_m.dtype == np.float32
    assert depth_m[0, 0] == depth_m[0, 1] == 0
    np.testing.assert_allclose(depth_m[1:], raw[1:] / 1000.0, rtol=1e-7)
    assert read_depth_m(tmp_path / "d.png", 5000.0)[0, 1] == np.float32(65535 / 5000)


@pytest.mark.parametrize("ending", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_cut_images_are_errors(tmp_path: Path, ending: str, share: float) -> None:
    path = tmp_path / f"i{ending}"
    write_image(path, np.tile(image_rgb(0), (10, 10, 1)))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ImageDecodeError, match=f"i{ending}: the image"):
        read_image_rgb(path)


def test_a_thumbnail_does_not_hide_the_cut(tmp_path: Path) -> None:
    _, small = cv2.imencode(".jpg", image_rgb(1))
    _, large = cv2.imencode(".jpg", np.tile(image_rgb(0), (10, 10, 1)))
    thumbnail = small.tobytes()
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = large.tobytes()[:2] + segment + large.tobytes()[2:]
    path = tmp_path / "i.jpg"
    path.write_bytes(whole)
    assert read_image_rgb(path).shape == (120, 160, 3)
    path.write_bytes(whole[:-50])
    with pytest.raises(ImageDecodeError, match="cut short"):
        read_image_rgb(path)


MOVIE = b"\x00\x00\x00\x18ftypmp42" + b"\xff\xda\xff\xd8\xff\x00" * 1000
"""What a phone appends to a photo that moves; its bytes may be any."""


@pytest.mark.parametrize("ending", [".png", ".jpg"])
@pytest.mark.parametrize("appended", [MOVIE, b"\xff\xda", b"\x00" * 5000], ids=["movie", "scan", "zeros"])
def test_what_is_appended_does_not_cut_an_image(tmp_path: Path, ending: str, appended: bytes) -> None:
    path = tmp_path / f"i{ending}"
    write_image(path, np.tile(image_rgb(0), (10, 10, 1)))
    expected, whole = read_image_rgb(path), path.read_bytes()
    path.write_bytes(whole + appended)
    np.testing.assert_array_equal(read_image_rgb(path), expected)
    path.write_bytes(whole[: len(whole) // 2] + MOVIE)
    with pytest.raises(ImageDecodeError):
        read_image_rgb(path)


@pytest.mark.parametrize(
    "options",
    [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]],
    ids=["baseline", "progressive", "restarts"],
)
def test_every_cut_of_a_jpeg_is_found(options: list[int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 80, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 98, *options])[1].tobytes()
    assert b"\xff\x00" in data
    assert not is_cut_short(data)
    assert not is_cut_short(data + MOVIE)
    assert all(is_cut_short(data[:length]) for length in range(3, len(data), 7))
    assert is_cut_short(data[:-1])


def test_every_cut_of_a_png_is_found() -> None:
    data = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (64, 80, 3), np.uint8))[1].tobytes()
    assert not is_cut_short(data + b"IEND" * 2000)
    assert all(is_cut_short(data[:length]) for length in range(8, len(data)))


def test_a_png_whose_chunk_claims_gigabytes_is_not_decoded(tmp_path: Path) -> None:
    """OpenCV would reserve and clear them first."""
    data = bytearray(cv2.imencode(".png", np.zeros((12, 16), np.uint8))[1].tobytes())
    at = data.index(b"IDAT") - 4
    data[at : at + 4] = (0xA9000026).to_bytes(4, "big")
    (tmp_path / "i.png").write_bytes(bytes(data))
    with pytest.raises(ImageDecodeError, match="cut short"):
        read_image_rgb(tmp_path / "i.png")


def test_no_image_and_wrong_depth_are_errors(tmp_path: Path) -> None:
    (tmp_path / "i.png").write_text("not an image")
    with pytest.raises(ImageDecodeError, match="does not decode"):
        read_image_rgb(tmp_path / "i.png")
    with pytest.raises(ImageDecodeError, match="No such file"):
        read_image_rgb(tmp_path / "none.png")
    with pytest.raises(ImageDecodeError):
        read_image_rgb(tmp_path)
    for image in (image_rgb(0), image_rgb(0)[..., 0]):
        write_image(tmp_path / "d.png", image)
        with pytest.raises(ImageDecodeError, match="one channel of 16 bits"):
            read_depth_m(tmp_path / "d.png", 5000.0)


# Text and JSON


class Colour(Enum):
    RED = "red"


def test_json_takes_what_a_report_holds(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_json(
        path,
        {
            "a": np.float64(1.5), "b": np.int64(2), "c": np.bool_(True), "d": float("nan"),
            "e": np.float32("inf"), "f": np.arange(3), "g": (1, [np.nan]), "h": Path("x/y"),
            "i": Colour.RED, 3: None, "k": {2, 1}, "l": "é",
        },
    )  # fmt: skip
    assert json.loads(path.read_text(encoding="utf-8")) == {
        "a": 1.5, "b": 2, "c": True, "d": None, "e": None,
        "f": [0, 1, 2], "g": [1, [None]], "h": "x/y", "i": "red", "3": None, "k": [1, 2], "l": "é",
    }  # fmt: skip
    with pytest.raises(TypeError):
        write_json(path, object())


def test_text_is_whole_or_absent(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "é\n")
    assert (tmp_path / "a.txt").read_bytes() == b"\xc3\xa9\n"
    for bad in (tmp_path / "none" / "a.txt", tmp_path / "a.txt" / "b.txt", tmp_path):
        with pytest.raises(OutputError, match="cannot be written") as caught:
            write_text(bad, "x")
        assert "\n" not in str(caught.value)
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("replace", [replacing, replacing_folder])
def test_what_cannot_be_read_is_not_said_to_be_unwritable(
    replace: Callable[[Path], AbstractContextManager[Path]], tmp_path: Path
) -> None:
    source, place = tmp_path / "source.ply", tmp_path / "out"
    with pytest.raises(InputError) as caught, replace(place) as temporary:
        shutil.copyfile(source, temporary / "x" if temporary.is_dir() else temporary)
    assert str(caught.value) == f"{source}: cannot be read: No such file or directory"
    assert not isinstance(caught.value, OutputError)
    full = OSError(errno.ENOSPC, "No space left on device", str(source), None, str(place / "x"))
    with pytest.raises(OutputError, match="out: cannot be written: No space left"), replace(place):
        raise full  # as a copy does
    assert os.listdir(tmp_path) == []


def test_new_files_have_ordinary_permissions(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "x")
    (tmp_path / "b").write_text("x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_replacing_keeps_the_ending_and_cleans_up(tmp_path: Path) -> None:
    def fail() -> None:
        with replacing(tmp_path / "mesh.ply") as temporary:
            assert temporary.suffix == ".ply"
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert os.listdir(tmp_path) == []


def test_lines_are_numbered_as_editors_do(tmp_path: Path) -> None:
    path = tmp_path / "l.txt"
    path.write_bytes("﻿# c\r\na\x0bb\r\n\r\n  \u2028 c\n#\nd".encode())
    assert read_lines(path) == [(2, "a\x0bb"), (4, "c"), (6, "d")]
