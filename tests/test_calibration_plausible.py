# SPDX-License-Identifier: Apache-2.0
"""Intrinsics that no camera has are refused where a file says them, real ones never."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequences import make_sevenscenes

from slamdepth.calibration.plausible import check_plausible, fold_radius, horizontal_view_deg
from slamdepth.datasets import open_dataset, write_camera
from slamdepth.datasets.readers import sevenscenes, tum
from slamdepth.errors import CameraError
from slamdepth.types import Camera

PLAIN = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
REAL = [
    *tum._KNOWN_CAMERAS.values(),
    sevenscenes.CAMERA,
    # EuRoC's cam0, OpenCV's sample, a webcam of ROS
    Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019, 0.0000176, 0.0)),
    Camera(640, 480, 535.9, 535.9, 342.3, 235.6, (-0.2663726, -0.0385844, 0.0017832, -0.000281, 0.2383906)),
    Camera(640, 480, 438.783, 437.303, 305.593, 243.738, (-0.361976, 0.11051, 0.001014, 0.000505, 0.0)),
]


@pytest.mark.parametrize("camera", REAL)
def test_real_cameras_pass(camera: Camera) -> None:
    for one in (camera, camera.mirrored(), camera.scaled(320, 240), camera.without_distortion()):
        assert check_plausible(one) == []


def with_distortion(*distortion: float) -> Camera:
    return Camera(640, 480, 525.0, 525.0, 319.5, 239.5, distortion)


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (Camera(640, 480, 525, 525, 639.6, 240), "cx 639.6 lies outside the image, whose width is 640"),
        (Camera(640, 480, 525, 525, 320, -0.6), "cy -0.6 lies outside the image, whose height is 480"),
        (with_distortion(-0.6, 0, 0, 0, 0), r"turns back 6[45] % of the way .* farthest corner"),
        (with_distortion(0, 0, 0, 0, -3.0), "turns back"),
        (with_distortion(50, 0.2, 0, 0, 100), "cannot be undone"),
        (with_distortion(0, 0, 0.3, 0, 0), "cannot be undone"),  # tangential where k3 was meant
        (with_distortion(0, 0, 0, 1e300, 0), "too strong"),
    ],
)
def test_what_no_camera_has(camera: Camera, says: str) -> None:
    with pytest.raises(CameraError, match=says):
        check_plausible(camera)


def at(width: int, height: int, fx: float, cx: float, cy: float, fy: float | None = None) -> Camera:
    return Camera(width, height, fx, fx if fy is None else fy, cx, cy)


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (
            at(640, 480, 1050, 639.5, 479.5),
            "fits an image of about 1280x960, not 640x480: the intrinsics are",
        ),
        (at(640, 480, 262.5, 159.5, 119.5), "fits an image of about 320x240, not 640x480"),
        (at(640, 480, 1000, 639.5, 359.5), "fits an image of about 1280x720, not 640x480"),
        (at(1280, 720, 525, 319.5, 239.5), "fits an image of about 640x480, not 1280x720"),
        (at(1920, 1080, 900, 639.5, 359.5), "fits an image of about 1280x720, not 1920x1080"),
        (at(640, 480, 525, 319.5, 60), "fits an image of about 640x121"),
        (at(640, 480, 525, 0, 0), "at the edge of the image, .* about 319.5 239.5: was it never set"),
        (at(640, 480, 525, 0, 239.5), "at the edge of the image, .*: was it never set"),
        (at(640, 480, 525, 0.5, 0.5), "at the edge of the image, .*: is it normalised"),
        (at(640, 480, 3.637, 319.5, 239.5), "fx 3.637 is a view of 179 degrees .* is it in millimetres"),
        (at(640, 480, 525, 319.5, 239.5, 3.6), "fy 3.6 is a view of 178 degrees .* millimetres"),
        (at(640, 480, 50, 319.5, 239.5), "fx 50 is a view of 162 degrees .* millimetres"),
        (at(640, 480, 0.82, 0.5, 0.5, 1.09), "Multiply fx and cx by the width 640"),
        (at(640, 480, 1.5, 0.0, 0.0), "are they normalised"),
    ],
)
def test_intrinsics_of_another_size_or_unit_are_refused_with_the_likely_reason(
    camera: Camera, says: str
) -> None:
    with pytest.raises(CameraError, match=says):
        check_plausible(camera)


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (at(640, 480, 525, 319.5, 150), "fits an image of about 640x301, not 640x480: unless the images are"),
        (at(640, 480, 656, 399.5, 299.5), "fits an image of about 800x600"),
        (at(800, 600, 525, 319.5, 239.5), "fits an image of about 640x480"),
        (at(640, 480, 525, 239.5, 319.5), "fits an image of about 480x640"),
        (at(640, 480, 3637, 319.5, 239.5), "only 10.1 degrees .* in micrometres"),
    ],
)
def test_what_may_be_right_is_noted(camera: Camera, says: str) -> None:
    (note,) = check_plausible(camera)
    assert re.search(says, note)


@settings(deadline=None, max_examples=200)
@given(st.floats(0.2, 5.0), st.sampled_from([(640, 480), (1280, 720), (752, 480), (480, 640)]))
def test_intrinsics_of_another_size_never_pass_in_silence(factor: float, size: tuple[int, int]) -> None:
    """Of an image an eighth smaller or larger and beyond; of about the same size they do."""
    width, height = size
    own = Camera(width, height, 0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2)
    wrong = Camera(
        width, height, factor * own.fx, factor * own.fy,
        factor * (own.cx + 0.5) - 0.5, factor * (own.cy + 0.5) - 0.5,
    )  # fmt: skip
    try:
        notes = check_plausible(wrong)
    except CameraError:
        assert not 0.8 < factor < 1.2
        return
    assert 0.75 < factor < 1.3
    assert bool(notes) or 0.87 < factor < 1.13


def test_the_radius_of_the_fold_is_the_largest_the_lens_reaches() -> None:
    assert fold_radius(PLAIN) == math.inf
    assert fold_radius(with_distortion(-0.4, 0, 0, 0, 0)) == pytest.approx(math.sqrt(1 / 1.2) * 2 / 3)


@settings(deadline=None, max_examples=200)
@given(*[st.floats(-2.0, 2.0)] * 3)
def test_no_pixel_of_what_passes_is_seen_twice(k1: float, k2: float, k3: float) -> None:
    camera = with_distortion(k1, k2, 0.0, 0.0, k3)
    try:
        notes = check_plausible(camera)
    except CameraError:
        return
    if notes:
        assert "turns back 9" in notes[0]  # in the outermost tenth, where it is no error
        return
    r = np.linspace(0.0, 10.0, 20_001)
    reached = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    inside = reached[: np.argmax(reached > math.hypot(320, 240) / 525)]
    assert len(inside)
    assert (np.diff(inside) > 0).all()


@settings(deadline=None, max_examples=200)
@given(*[st.floats(-1.0, 1.0)] * 6)
def test_no_pixel_of_a_rational_lens_that_passes_is_seen_twice(
    k1: float, k2: float, k3: float, k4: float, k5: float, k6: float
) -> None:
    camera = with_distortion(k1, k2, 0.0, 0.0, k3, k4, k5, k6)
    try:
        notes = check_plausible(camera)
    except CameraError:
        return
    if notes:
        assert "turns back 9" in notes[0]
        return
    r = np.linspace(0.0, 10.0, 20_001)
    below = 1 + k4 * r**2 + k5 * r**4 + k6 * r**6
    reached = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / below
    inside = reached[: np.argmax(reached > math.hypot(320, 240) / 525)]
    assert len(inside)
    assert (np.diff(inside) > 0).all()


def test_pixels_of_a_strong_rational_lens_come_back_exactly() -> None:
    camera = with_distortion(8.2, 3.1, 1e-4, -2e-4, 0.12, 8.6, 5.9, 0.9)
    assert check_plausible(camera) == []
    raw_px = np.random.default_rng(0).uniform(0, [639, 479], (200, 2))
    plane = (camera.undistort_points(raw_px) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.column_stack([plane, np.ones(len(plane))])
    back_px, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
    np.testing.assert_allclose(back_px[:, 0], raw_px, atol=1e-6)


@settings(deadline=None, max_examples=200)
@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 5))
def test_any_numbers_are_plausible_or_refused(distortion: tuple[float, ...]) -> None:
    try:
        notes = check_plausible(with_distortion(*distortion))
    except CameraError:
        return
    assert all("turns back 9" in note for note in notes)


def test_a_very_wide_view_is_noted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    wide = Camera(640, 480, 105.0, 105.0, 319.5, 239.5)
    assert horizontal_view_deg(wide) == pytest.approx(2 * math.degrees(math.atan(320 / 105.0)))
    assert check_plausible(Camera(640, 480, 190.0, 190.0, 319.5, 239.5)) == []
    path = tmp_path / "camera.yaml"
    write_camera(path, wide)
    with caplog.at_level(logging.WARNING, logger="slamdepth"):
        assert Camera.from_file(path) == wide
    said = "camera.yaml: fx 105 is a horizontal view of 144 degrees in an image 640 pixels wide"
    assert said in caplog.text
    write_camera(make_sevenscenes(tmp_path / "inside") / "camera.yaml", wide)
    for dataset in (
        open_dataset(tmp_path / "inside"),
        open_dataset(make_sevenscenes(tmp_path / "seq"), path),
    ):
        assert dataset.notes[0].startswith(said)
