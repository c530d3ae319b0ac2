# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: how they are found, printed, and what they tell of a camera."""

from __future__ import annotations

import re
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_images import board_image, board_poses, rays_of

from slamdepth.boards.adjust import Fit, fit_board
from slamdepth.boards.board import DEFAULT_BOARD, Board, Sighting
from slamdepth.boards.choose import View, chosen_views, edge_width_px
from slamdepth.boards.lens import BROWN_CONRADY, FISHEYE, LensModel
from slamdepth.boards.verdict import advice, check_fit, check_views, coverage, projection_sigma_px
from slamdepth.calibration import WideLens
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.report.board import write_board
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats

PINHOLE = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.26, -0.95, -0.005, 0.0026, 1.16))
WIDE = Camera(640, 480, 240.0, 241.0, 325.0, 236.0, lens=WideLens("fisheye", (-0.02, 0.01, -0.003, 0.0002)))
BOARD, CHECKERBOARD = Board.parse(DEFAULT_BOARD), Board.parse("9x6")


def model_and_truth(camera: Camera) -> tuple[LensModel, Floats]:
    numbers = camera.distortion if camera.lens is None else camera.lens.coefficients
    model = BROWN_CONRADY if camera.lens is None else FISHEYE
    return model, np.array([camera.fx, camera.fy, camera.cx, camera.cy, *numbers])


def size_of(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def seen(camera: Camera, board: Board, poses: list[Floats], noise_px: float, seed: int = 0) -> list[Sighting]:
    """Corners projected exactly, with noise."""
    model, truth = model_and_truth(camera)
    rng = np.random.default_rng(seed)
    found = []
    for T in poses:
        points = board.corners_mm @ T[:3, :3].T + T[:3, 3]
        px = model.project(truth, points) + rng.normal(0.0, noise_px, (len(points), 2))
        inside = (px > 0).all(axis=1) & (px < np.array(size_of(camera)) - 1).all(axis=1)
        # a polynomial folds points from far outside back into the image
        rays = rays_of(camera, px)
        is_true = np.linalg.norm(rays - points / np.linalg.norm(points, axis=1)[:, None], axis=1) < 0.1
        found.append(Sighting(np.flatnonzero(inside & is_true), px[inside & is_true]))
    return [sighting for sighting in found if len(sighting.ids) >= 10]


@pytest.mark.parametrize("camera", [PINHOLE, WIDE], ids=["pinhole", "fisheye"])
def test_exact_corners_give_the_exact_camera(camera: Camera) -> None:
    model, truth = model_and_truth(camera)
    fit = fit_board(
        model, BOARD, seen(camera, BOARD, board_poses(BOARD, camera, 12, 1), 0.0), size_of(camera)
    )
    np.testing.assert_allclose(fit.values[:4], truth[:4], atol=1e-3)
    np.testing.assert_allclose(fit.values[4:], truth[4:], atol=1e-4)
    assert fit.rms_px < 1e-4


@pytest.mark.parametrize("camera", [PINHOLE, WIDE], ids=["pinhole", "fisheye"])
def test_deviations_are_as_large_as_the_errors(camera: Camera) -> None:
    model, truth = model_and_truth(camera)
    errors, sigmas = [], []
    for seed in range(6):
        sightings = seen(camera, BOARD, board_poses(BOARD, camera, 15, seed), 0.2, seed)
        fit = fit_board(model, BOARD, sightings, size_of(camera))
        errors.append(fit.values - truth)
        sigmas.append(fit.sigma)
        assert fit.rms_px == pytest.approx(0.2 * np.sqrt(2.0), rel=0.2)
    standard = np.array(errors) / np.array(sigmas)
    assert 0.5 < np.sqrt(np.mean(standard**2)) < 1.6
    assert np.abs(standard).max() < 4.5


@pytest.mark.parametrize(
    ("camera", "board"),
    [(PINHOLE, BOARD), (PINHOLE, CHECKERBOARD), (WIDE, BOARD)],
    ids=["charuco", "checkerboard", "fisheye"],
)
def test_images_of_a_board_give_the_camera_within_its_deviations(camera: Camera, board: Board) -> None:
    images = [
        board_image(board, camera, T, 2.0, number)
        for number, T in enumerate(board_poses(board, camera, 12, 1))
    ]
    sightings = [found for found in map(board.find, images) if found is not None]
    assert len(sightings) >= 9
    model, truth = model_and_truth(camera)
    fit = fit_board(model, board, sightings, size_of(camera))
    assert np.abs((fit.values - truth) / fit.sigma).max() < 4.0
    assert fit.sigma[0] < 0.004 * fit.values[0]
    assert fit.rms_px < 0.3
    check_fit(fit)


def test_a_wrong_corner_hardly_matters() -> None:
    sightings = seen(PINHOLE, BOARD, board_poses(BOARD, PINHOLE, 12, 1), 0.1)
    for sighting in sightings[:6]:
        sighting.px[5] += 25.0
    model, truth = model_and_truth(PINHOLE)
    fit = fit_board(model, BOARD, sightings, size_of(PINHOLE))
    assert np.abs(fit.values[:4] - truth[:4]).max() < 1.5


def test_a_board_that_faces_the_camera_is_refused() -> None:
    poses = board_poses(BOARD, PINHOLE, 12, 1, tilt_deg=0.0)
    for T in poses:  # not even turned towards the line of sight
        T[:3, :3] = np.eye(3)
    sightings = seen(PINHOLE, BOARD, poses, 0.1)
    fit = fit_board(BROWN_CONRADY, BOARD, sightings, size_of(PINHOLE))
    with pytest.raises(
        DatasetError, match=r"do not determine the focal length .* tilt it by 30 to 45"
    ) as said:
        check_fit(fit)
    assert "\n" not in str(said.value)


def test_too_few_views_are_refused() -> None:
    with pytest.raises(DatasetError, match="none of 30 images shows the board charuco:10x7: name yours"):
        check_views(0, 30, BOARD.name)
    with pytest.raises(
        DatasetError, match=r"only 4 of 30 images show the board .*: film it for half a minute"
    ):
        check_views(4, 30, BOARD.name)
    check_views(5, 30, BOARD.name)


def views_of(sightings: list[Sighting], edge_px: float = 1.5) -> list[View]:
    return [View(f"{number}.png", sighting, edge_px) for number, sighting in enumerate(sightings)]


def good_fit(poses: list[Floats]) -> tuple[Fit, list[View]]:
    sightings = seen(PINHOLE, BOARD, poses, 0.1)
    return fit_board(BROWN_CONRADY, BOARD, sightings, size_of(PINHOLE)), views_of(sightings)


def test_a_good_calibration_needs_no_advice() -> None:
    fit, views = good_fit(board_poses(BOARD, PINHOLE, 24, 1))
    assert advice(fit, views, size_of(PINHOLE)) == []
    assert projection_sigma_px(fit, size_of(PINHOLE)) < 0.5
    assert min(coverage(views, size_of(PINHOLE)).values()) > 10


def test_what_to_film_is_said_where_the_images_leave_gaps() -> None:
    poses = []
    for T in board_poses(BOARD, PINHOLE, 60, 1):
        rightmost = (BOARD.corners_mm @ T[:3, :3].T + T[:3, 3])[:, 0].max()
        poses += [T] if rightmost < 40.0 else []
    fit, views = good_fit(poses)
    views = [replace(view, edge_px=9.0) for view in views]
    said = " ".join(advice(fit, views, size_of(PINHOLE)))
    assert "right in the image: film it there" in said
    assert "edges are 9.0 pixels wide" in said


def test_sharp_and_different_views_are_chosen() -> None:
    sightings = seen(PINHOLE, BOARD, board_poses(BOARD, PINHOLE, 12, 1), 0.0)
    views = views_of(sightings) + [
        replace(view, name=f"blurred {view.name}", edge_px=8.0) for view in views_of(sightings)
    ]
    many = [replace(view, name=f"{copy} {view.name}") for copy in range(8) for view in views]
    chosen = chosen_views(many, BOARD, size_of(PINHOLE))
    assert not any("blurred" in view.name for view in chosen)
    assert len({view.sighting.px.tobytes() for view in chosen}) == len(sightings) == len(chosen)
    assert chosen_views([], BOARD, size_of(PINHOLE)) == []


def test_the_width_of_edges_tells_how_blurred_an_image_is() -> None:
    for board in (BOARD, CHECKERBOARD):
        image = board_image(board, PINHOLE, board_poses(board, PINHOLE, 6, 2)[5], 1.0, 0)
        sharp = board.find(image)
        assert sharp is not None
        widths = [edge_width_px(board, sharp, blurred(image, px)) for px in (1, 5, 9)]
        assert widths[0] < 3.0
        assert widths == sorted(widths)
        assert widths[2] > widths[0] + 2.0


def blurred(image: Bytes, px: int) -> Bytes:
    """Moved sideways by ``px`` pixels during the exposure."""
    return np.asarray(cv2.blur(image, (px, 1)), np.uint8)


@pytest.mark.parametrize("text", ["charuco:10x7", "charuco:8x5:DICT_5X5_100:0.7", "checkerboard:9x6"])
def test_the_name_of_a_board_is_read_back(text: str) -> None:
    board = Board.parse(text, 30.0)
    assert board.name == text
    assert Board.parse(board.name, 30.0) == board


@pytest.mark.parametrize(
    ("text", "square_mm", "problem"),
    [
        ("round", 25.0, "board 'round': expected charuco:COLUMNSxROWS"),
        ("circles:9x6", 25.0, "expected charuco"),
        ("charuco:2x7", 25.0, "columns and rows must be 3 to 60"),
        ("charuco:10x70", 25.0, "columns and rows must be 3 to 60"),
        ("charuco:20x20", 25.0, "needs 200 markers, and DICT_4X4_50 has fewer"),
        ("charuco:10x7:DICT_9X9", 25.0, "unknown family 'DICT_9X9'"),
        ("charuco:10x7:DICT_4X4_50:0.1", 25.0, "markers must be 0.3 to 0.95 of a square"),
        ("checkerboard:9x6:DICT_4X4_50", 25.0, "a checkerboard has no markers"),
        ("9x6", float("nan"), "--square-mm nan: must be 1 to 2000"),
        ("9x6", 0.0, "--square-mm 0: must be 1 to 2000"),
    ],
)
def test_a_board_that_is_none_is_refused(text: str, square_mm: float, problem: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(problem)):
        Board.parse(text, square_mm)


@pytest.mark.parametrize(
    "text", ["charuco:10x7", "charuco:7x10", "charuco:8x5:DICT_5X5_100:0.7", "9x6", "6x8"]
)
@pytest.mark.parametrize("paper", ["a4", "letter"])
def test_the_printed_board_has_its_exact_size(tmp_path: Path, text: str, paper: str) -> None:
    """The PDF's own polygons, in millimetres, are found as the board."""
    board = Board.parse(text, 22.0)
    write_board(tmp_path / "board.pdf", board, paper)
    page_mm, polygons = read_pdf((tmp_path / "board.pdf").read_bytes())
    assert sorted(page_mm) == pytest.approx({"a4": [210.0, 297.0], "letter": [215.9, 279.4]}[paper], abs=0.01)
    scale = 8.0  # pixels a millimetre
    image = np.full((round(scale * page_mm[1]), round(scale * page_mm[0])), 255, np.uint8)
    for x0, y0, x1, y1 in polygons:
        a, b, c, d = (round(scale * value) for value in (x0, page_mm[1] - y1, x1, page_mm[1] - y0))
        image[b:d, a:c] = 0
    found = board.find(image)
    assert found is not None
    assert len(found.ids) == len(board.corners_mm)
    distances = np.linalg.norm(found.px[1:] - found.px[:-1], axis=1) / scale
    assert np.median(distances) == pytest.approx(22.0, abs=0.05)
    first = (tmp_path / "board.pdf").read_bytes()
    write_board(tmp_path / "again.pdf", board, paper)
    assert first == (tmp_path / "again.pdf").read_bytes()


def read_pdf(data: bytes) -> tuple[list[float], list[tuple[float, float, float, float]]]:
    """Size of the page, and its filled rectangles (x0, y0, x1, y1), in millimetres from the bottom left."""
    mm = 25.4 / 72.0
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data)
    assert box is not None
    rectangles = []
    for stream in re.finditer(rb"stream\r?\n(.*?)endstream", data, re.DOTALL):
        try:
            text = zlib.decompress(stream[1]).decode("latin-1")
        except zlib.error:
            continue
        for corners in re.findall(r"([\d.]+ [\d.]+) m\n((?:[\d.]+ [\d.]+ l\n){3})h\n\nf\n", text):
            numbers = np.array(" ".join(corners).replace(" l\n", " ").split(), float).reshape(4, 2) * mm
            rectangles.append((*numbers.min(axis=0).tolist(), *numbers.max(axis=0).tolist()))
    page = [float(value) * mm for value in box.groups()]
    return page, [r for r in rectangles if r[2] - r[0] < 0.9 * page[0]]


def test_a_board_larger_than_the_paper_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a board of 500 x 350 mm does not fit on a4: smaller squares"):
        write_board(tmp_path / "board.pdf", Board.parse(DEFAULT_BOARD, 50.0))
    with pytest.raises(ConfigError, match="--paper a9: known are a4, letter"):
        write_board(tmp_path / "board.pdf", BOARD, "a9")
    assert not (tmp_path / "board.pdf").exists()


def test_the_board_is_that_of_opencv() -> None:
    black, cell_mm = BOARD.is_black()
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.CharucoBoard((10, 7), 25.0, 0.75 * 25.0, dictionary).generateImage((800, 560))
    assert cell_mm == 25.0 / 8.0
    ours = np.kron(np.where(black, 0, 255), np.ones((10, 10))).astype(np.uint8)
    np.testing.assert_array_equal(ours, theirs)
