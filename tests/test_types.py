# SPDX-License-Identifier: Apache-2.0
"""The value types: conventions and what they refuse."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamdepth.datasets.orientation import turned_camera
from slamdepth.dense.rectify import Rectifier
from slamdepth.errors import CameraError
from slamdepth.training.lens import raw_pixels, turning_point
from slamdepth.types import Camera, Frame, Trajectory

FR1 = Camera(
    640, 480, 517.306408, 516.469215, 318.643040, 255.313989,
    (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
)  # fmt: skip


TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@given(st.integers(32, 2000), st.integers(32, 2000))
def test_scaled_keeps_pixel_areas_in_place(width: int, height: int) -> None:
    """A corner of the image stays that corner: pixel (-0.5, -0.5) and (w - 0.5, h - 0.5)."""
    small = FR1.scaled(width, height)
    assert (small.width, small.height) == (width, height)
    for corner, there in (
        (np.array([-0.5, -0.5]), np.array([-0.5, -0.5])),
        (np.array([639.5, 479.5]), np.array([width - 0.5, height - 0.5])),
    ):
        ray = (corner - [FR1.cx, FR1.cy]) / [FR1.fx, FR1.fy]
        np.testing.assert_allclose(ray * [small.fx, small.fy] + [small.cx, small.cy], there, atol=1e-9)
    assert small.distortion == FR1.distortion


def test_scaled_agrees_with_an_area_resize() -> None:
    """The centre of the brightness of a blob moves as the principal point does."""
    image = np.zeros((48, 64), np.float32)
    image[8:12, 20:28] = 1.0  # centre (23.5, 9.5)
    camera = Camera(64, 48, 50, 50, 23.5, 9.5)
    half = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA)
    v, u = np.nonzero(half)
    small = camera.scaled(32, 24)
    assert (small.cx, small.cy) == pytest.approx((u.mean(), v.mean()))


def test_K_and_distortion() -> None:
    np.testing.assert_array_equal(FR1.K[:2], [[FR1.fx, 0, FR1.cx], [0, FR1.fy, FR1.cy]])
    np.testing.assert_array_equal(FR1.distortion_array, FR1.distortion)
    assert FR1.is_distorted
    assert not FR1.without_distortion().is_distorted
    assert hash(FR1) != hash(FR1.without_distortion())


def test_undistort_points_undoes_the_brown_conrady_model() -> None:
    grid = np.stack(np.meshgrid(np.linspace(40, 600, 9), np.linspace(40, 440, 7)), -1).reshape(-1, 2)
    x, y = ((grid - [FR1.cx, FR1.cy]) / [FR1.fx, FR1.fy]).T
    k1, k2, p1, p2, k3 = FR1.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    raw = np.stack([FR1.fx * xd + FR1.cx, FR1.fy * yd + FR1.cy], axis=1)
    np.testing.assert_allclose(FR1.undistort_points(raw), grid, atol=0.05)


RATIONAL = Camera(
    640, 480, 420.0, 421.0, 318.0, 243.0, (0.6, -2.6, 3e-4, -2e-4, 1.5, 0.48, -2.4, 1.4), fps=15.0
)  # fmt: skip
"""As of a depth camera of 80 degrees: k4, k5, k6 besides."""


def test_eight_coefficients_are_used_wherever_five_are() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), -1).reshape(-1, 2)
    pinhole = RATIONAL.without_distortion()
    assert pinhole.distortion == (0.0,) * 5
    assert (RATIONAL.is_distorted, pinhole.is_distorted) == (True, False)
    rays = np.column_stack(
        [(RATIONAL.undistort_points(grid) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy], np.ones(63)]
    )
    np.testing.assert_allclose(raw_pixels(rays, RATIONAL), grid, atol=1e-6)
    mirrored = RATIONAL.mirrored()
    expected = [639.0, 0.0] + grid * [-1.0, 1.0]
    np.testing.assert_allclose(raw_pixels(rays * [-1.0, 1.0, 1.0], mirrored), expected, atol=1e-6)
    upright = turned_camera(RATIONAL, 6)
    turned = np.column_stack([479.0 - grid[:, 1], grid[:, 0]])
    np.testing.assert_allclose(raw_pixels(rays @ TURNED.T, upright), turned, atol=1e-6)
    rectifier = Rectifier.of(RATIONAL, 640, 0.0)
    positions = rectifier.positions(None, 0.5)
    assert positions is not None
    there = np.column_stack([(100 - pinhole.cx) / pinhole.fx, (50 - pinhole.cy) / pinhole.fy, 1.0])
    np.testing.assert_allclose(positions[50, 100], raw_pixels(there, RATIONAL)[0], atol=1e-3)


def test_rays_beyond_a_rational_lens_do_not_fold_back() -> None:
    camera = Camera(640, 480, 420.0, 421.0, 318.0, 243.0, (-0.3, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0))
    limit = turning_point(camera)
    r = np.linspace(0.0, 4.0, 40_001)
    reached = r * (1 - 0.3 * r**2) / (1 + 0.1 * r**2)
    assert limit == pytest.approx(r[np.argmax(np.diff(reached) < 0)], abs=2e-3)


def test_undistort_points_of_a_pinhole_copies() -> None:
    points = np.array([[1.0, 2.0], [3.5, 4.0]])
    same = FR1.without_distortion().undistort_points(points)
    np.testing.assert_array_equal(same, points)
    same[0] = 0.0
    assert points[0, 0] == 1.0
    assert FR1.undistort_points(np.zeros((0, 2))).shape == (0, 2)
    assert FR1.undistort_points(points.astype(np.float32)).dtype == np.float64


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": float("nan")}, "finite"),
        ({"fx": 0.0}, "fx and fy must be positive"),
        ({"width": 0}, "width and height"),
        ({"depth_factor": -1.0}, "depth_factor"),
        ({"fps": 0.0}, "fps"),
        ({"distortion": (0.1, 0.2)}, "five numbers"),
    ],
)
def test_cameras_that_cannot_be(change: dict[str, Any], says: str) -> None:
    values = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0, **change}
    with pytest.raises(CameraError, match=says):
        Camera(**values)


def test_a_frame_must_fit_its_camera() -> None:
    camera = Camera(4, 3, 5, 5, 1.5, 1)
    image = np.zeros((3, 4, 3), np.uint8)
    frame = Frame(7, 0.5, image, camera, np.zeros((3, 4), np.float32))
    with pytest.raises(FrozenInstanceError):
        frame.index = 1  # type: ignore[misc]
    other_type: np.ndarray = image.astype(np.float32)
    for wrong in (image[:, :3], image[..., 0], other_type, np.zeros((4, 3, 3), np.uint8)):
        with pytest.raises(CameraError, match="frame 7: image is"):
            Frame(7, 0.5, wrong, camera)
    with pytest.raises(CameraError, match="frame 7: depth is"):
        Frame(7, 0.5, image, camera, np.zeros((4, 3), np.float32))


DIRECTIONS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def frame_with_gravity(gravity: Any) -> Frame:
    camera = Camera(4, 3, 5, 5, 1.5, 1)
    return Frame(7, 0.5, np.zeros((3, 4, 3), np.uint8), camera, gravity=gravity)


@given(DIRECTIONS, st.floats(0.991, 1.009))
def test_a_frame_takes_a_unit_direction_of_gravity_as_it_is(direction: Any, length: float) -> None:
    gravity = np.array(direction) / np.linalg.norm(direction) * length
    assert frame_with_gravity(gravity).gravity is gravity


@given(DIRECTIONS, st.one_of(st.floats(0.0, 0.98), st.floats(1.02, 1e6), st.just(float("nan"))))
def test_a_frame_refuses_gravity_of_another_length(direction: Any, length: float) -> None:
    gravity = np.array(direction) / np.linalg.norm(direction) * length
    with pytest.raises(
        CameraError, match=r"^frame 7: gravity must be a unit direction, its length is .*None$"
    ):
        frame_with_gravity(gravity)


@pytest.mark.parametrize(
    "gravity",
    [
        np.array([np.nan, 1.0, 0.0]),
        np.array([0.0, np.inf, 0.0]),
        np.array([0.0, 9.81, 0.0]),
        np.zeros(3),
        np.array([0.0, 1.0]),
        np.array([[0.0, 1.0, 0.0]]),
        np.array(1.0),
        np.array(["x", "y", "z"]),
        [0.0, 1.0, 0.0],
        9.81,
    ],
)
def test_what_is_no_direction_of_gravity(gravity: Any) -> None:
    with pytest.raises(CameraError, match="frame 7: gravity must be") as caught:
        frame_with_gravity(gravity)
    assert "\n" not in str(caught.value)


def test_a_trajectory_has_a_pose_for_each_time() -> None:
    assert len(Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))) == 3
    assert len(Trajectory(np.zeros(0), np.zeros((0, 4, 4)))) == 0
    for times, poses in (
        (np.arange(2.0), np.zeros((3, 4, 4))),
        (np.arange(2.0), np.zeros((2, 3, 4))),
        (np.zeros((2, 1)), np.zeros((2, 4, 4))),
    ):
        with pytest.raises(ValueError, match="a trajectory needs"):
            Trajectory(times, poses)
