# SPDX-License-Identifier: Apache-2.0
"""``slamdepth calibrate`` from images and videos of a board to a camera file."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_images import board_image, board_poses
from command_line import call, slamdepth
from PIL import Image

from slamdepth.boards.board import DEFAULT_BOARD, Board
from slamdepth.calibration import WideLens
from slamdepth.types import Camera

BOARD = Board.parse(DEFAULT_BOARD)
PINHOLE = Camera(640, 480, 517.3, 516.5, 318.6, 245.3, (0.1, -0.2, 0.001, -0.001, 0.0))
WIDE = Camera(480, 480, 180.0, 181.0, 241.0, 236.0, lens=WideLens("fisheye", (-0.02, 0.01, -0.003, 0.0002)))


def film(folder: Path, camera: Camera, count: int, tilt_deg: float = 35.0) -> Path:
    folder.mkdir()
    for number, T in enumerate(board_poses(BOARD, camera, count, 1, tilt_deg)):
        cv2.imwrite(str(folder / f"{number}.png"), board_image(BOARD, camera, T, 2.0, number))
    return folder


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("board") / "images", PINHOLE, 13)


def test_images_become_a_camera_file(tmp_path: Path, images: Path) -> None:
    done = slamdepth("calibrate", images, "--output", tmp_path / "phone.yaml")
    assert done.returncode == 0, done.stderr
    notes: list[str] = []
    camera = Camera.from_file(tmp_path / "phone.yaml", notes)
    assert notes == []
    details = json.loads((tmp_path / "phone-calibration" / "calibration.json").read_text())
    for name in ("fx", "fy", "cx", "cy"):
        error = abs(getattr(camera, name) - getattr(PINHOLE, name))
        assert error < 4.0 * details["sigma"][name]
        assert error < 3.0
    assert details["rms_px"] < 0.3
    assert len(details["views"]) >= 10
    assert {"image", "corners", "rms_px", "tilt_deg", "distance_mm", "edge_px"} == set(details["views"][0])
    picture = Image.open(tmp_path / "phone-calibration" / "coverage.png")
    assert np.asarray(picture.convert("L")).std() > 10
    text = (tmp_path / "phone.yaml").read_text()
    assert text.startswith("# slamdepth calibrate: ")
    assert "standard deviations: fx " in text
    assert "fps" not in text
    assert "RMS (px)" in done.stdout
    assert "camera     " in done.stdout


def test_keys_of_an_earlier_camera_file_stay(tmp_path: Path, images: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(
        "width: 9\nheight: 9\nfx: 9.0\nfy: 9.0\ncx: 4.0\ncy: 4.0\nfps: 12.5\ndepth_factor: 1000.0\n"
    )
    assert call("calibrate", images, "-o", path, "-q").returncode == 0
    camera = Camera.from_file(path)
    assert (camera.fps, camera.depth_factor, camera.width) == (12.5, 1000.0, 640)
    path.write_text("- a list\n")
    done = call("calibrate", images, "-o", path)
    assert (done.returncode, path.read_text()) == (2, "- a list\n")
    assert "is there already and no camera file" in done.stderr


def test_a_video_through_a_fisheye_is_calibrated(tmp_path: Path) -> None:
    folder = film(tmp_path / "images", WIDE, 14)
    writer = cv2.VideoWriter(str(tmp_path / "board.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (480, 480))
    for path in sorted(folder.iterdir()):
        writer.write(np.asarray(cv2.imread(str(path)), np.uint8))
    writer.release()
    done = call("calibrate", tmp_path / "board.avi", "--fisheye", "-o", tmp_path / "wide.yaml")
    assert done.returncode == 0, done.stderr
    camera = Camera.from_file(tmp_path / "wide.yaml", [])
    assert camera.lens is not None
    assert camera.lens.model == "fisheye"
    assert abs(camera.fx - 180.0) < 2.0
    assert abs(camera.cx - 241.0) < 2.0
    other = call("calibrate", tmp_path / "board.avi", "-o", tmp_path / "narrow.yaml")
    assert "with --fisheye" in other.stdout + other.stderr


def test_what_cannot_be_calibrated_is_one_line(tmp_path: Path, images: Path) -> None:
    few = tmp_path / "few"
    few.mkdir()
    for name in ("0.png", "1.png", "5.png"):
        (few / name).symlink_to(images / name)
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments, problem in (
        ((few,), "only 3 of 3 images show the board charuco:10x7, at least 5 are needed: film it"),
        (
            (few, "--board", "checkerboard:5x4"),
            "none of 3 images shows the board checkerboard:5x4: name yours",
        ),
        ((empty,), "no images in it"),
        ((tmp_path / "none.mp4",), "no such file or folder"),
        ((images / "0.png",), "neither a folder of images nor a video"),
        ((), "name a video or a folder of images"),
        ((images, "--print", tmp_path / "b.pdf"), "leave one of the two out"),
        ((images, "--board", "round"), "board 'round': expected charuco"),
        ((images, "-o", tmp_path / "no" / "camera.yaml"), "no such folder to write to"),
    ):
        done = (
            call("calibrate", *arguments)
            if "-o" in arguments
            else call("calibrate", *arguments, "-o", tmp_path / "camera.yaml")
        )
        assert done.returncode == 2, arguments
        assert problem in done.stderr, done.stderr
        assert len(done.stderr.strip().splitlines()[-1]) > 0
        assert not (tmp_path / "camera.yaml").exists()


def test_images_of_two_sizes_are_refused(tmp_path: Path, images: Path) -> None:
    (tmp_path / "0.png").symlink_to(images / "0.png")
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((100, 100), np.uint8))
    done = call("calibrate", tmp_path, "-o", tmp_path / "camera.yaml")
    assert done.returncode == 2
    assert "1.png is 100x100, others are 640x480: images of one camera have one size" in done.stderr


def test_the_board_is_printed(tmp_path: Path) -> None:
    done = slamdepth("calibrate", "--print", tmp_path / "board.pdf", "--paper", "letter")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    assert "print at 100 %" in done.stdout
    large = call("calibrate", "--print", tmp_path / "board.pdf", "--square-mm", "80")
    assert large.returncode == 2
    assert "does not fit on a4" in large.stderr
