# SPDX-License-Identifier: Apache-2.0
"""Manhattan frames of drawings of rooms, seen by cameras of known orientation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slamdepth.depth.vanishing import Lines, ManhattanFrame, find_lines, gravity_if_upright, manhattan_frames
from slamdepth.geometry import so3_exp
from slamdepth.types import Camera

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
DISTORTED = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
WITHIN_DEG = 1.5  # lines are found to half a pixel of a 340 pixel image, 0.1 degrees, over short lengths
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # columns: right, down, forward; the world's z is up


def rotation_of(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """``R_world_camera`` of a camera that looks down by its pitch, with gravity to the right by its roll."""
    turns = ([0, yaw_deg, 0], [-pitch_deg, 0, 0], [0, 0, roll_deg])
    yaw, pitch, roll = (so3_exp(np.radians(turn)) for turn in turns)
    R_world_camera: np.ndarray = UPRIGHT @ yaw @ pitch @ roll
    return R_world_camera


def any_turn(seed: int) -> np.ndarray:
    R, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    R *= np.linalg.det(R)
    return R


def segments(seed: int, count: int) -> np.ndarray:
    """Ends ``(N, 2, 3)`` of lines on the walls of a box around the origin, along its sides."""
    rng = np.random.default_rng(seed)
    half = np.array([2.5, 3.0, 2.0])
    ends = []
    for axis in range(3):
        for _ in range(count):
            middle = rng.uniform(-half, half)
            wall = rng.choice([k for k in range(3) if k != axis])
            middle[wall] = half[wall] * rng.choice([-1, 1])
            step = np.eye(3)[axis] * rng.uniform(0.4, 1.2)
            ends.append([middle - step, middle + step])
    return np.array(ends)


def drawn(ends: np.ndarray, R_world_camera: np.ndarray, camera: Camera) -> np.ndarray:
    """Dark and pale lines on grey, distorted as by the lens of the camera."""
    image = np.full((camera.height, camera.width, 3), 128, np.uint8)
    width = max(1, round(camera.width / 320))
    along = np.linspace(0.0, 1.0, 60)[:, None]
    for number, (a, b) in enumerate(ends):
        points = (a + along * (b - a)) @ R_world_camera
        x, y = (points[:, :2] / np.maximum(points[:, 2:], 0.1)).T
        margin = 0.05  # a lens polynomial means nothing far outside of the image
        seen = (points[:, 2] > 0.2) & (np.abs(x) < camera.width / 2 / camera.fx + margin)
        seen &= np.abs(y) < camera.height / 2 / camera.fy + margin
        if seen.sum() < 2:
            continue
        px, _ = cv2.projectPoints(points[seen], np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
        grey = 40 if number % 2 else 220
        cv2.polylines(
            image, [np.round(px * 16).astype(np.int32)], False, (grey,) * 3, width, cv2.LINE_AA, shift=4
        )
    return image


def off_deg(found: ManhattanFrame, R_world_camera: np.ndarray) -> float:
    """The largest angle from a true direction to the nearest one found, of either sense."""
    nearest = np.abs(R_world_camera @ found.axes.T).max(axis=1)  # true directions are the rows
    return float(np.degrees(np.arccos(np.minimum(nearest, 1.0)).max()))


def best(image: np.ndarray, camera: Camera) -> ManhattanFrame:
    return manhattan_frames(find_lines(image, camera), 1)[0]


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("seed", range(6))
def test_the_three_directions_of_a_room_are_found_from_any_viewpoint(camera: Camera, seed: int) -> None:
    R = any_turn(seed)
    found = best(drawn(segments(seed, 120), R, camera), camera)  # some along each side are in view
    assert off_deg(found, R) < WITHIN_DEG
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-9)


def test_distortion_is_undone() -> None:
    image = drawn(segments(1, 40), rotation_of(25, 10, 5), DISTORTED)
    right, ignored = (
        manhattan_frames(find_lines(image, camera))[0].support.sum()
        for camera in (DISTORTED, DISTORTED.without_distortion())
    )
    assert right > ignored


@pytest.mark.parametrize("roll_deg", [-30, 0, 20])
def test_the_same_lines_give_the_same_bytes(roll_deg: float) -> None:
    image = drawn(segments(2, 40), rotation_of(30, 15, roll_deg), CAMERA)
    first, again = (manhattan_frames(find_lines(image.copy(), CAMERA), 4) for _ in range(2))
    assert len(first) == len(again) > 1
    for one, other in zip(first, again, strict=True):
        assert one.axes.tobytes() == other.axes.tobytes()
        assert one.support.tobytes() == other.support.tobytes()


def test_a_quarter_turn_of_the_image_turns_its_lines_and_changes_nothing_else() -> None:
    image = drawn(segments(2, 40), rotation_of(30, 15, 0), CAMERA)
    turned_camera = Camera(480, 640, 520.0, 520.0, 239.5, 319.5)  # the top of the image is on its left
    lines = find_lines(image, CAMERA)
    turned = find_lines(np.ascontiguousarray(np.rot90(image)), turned_camera)
    assert len(turned) == pytest.approx(len(lines), rel=0.1)
    assert turned.weights.sum() == pytest.approx(lines.weights.sum(), rel=0.05)


def test_too_few_lines_give_no_frame() -> None:
    blank = np.full((240, 320, 3), 128, np.uint8)
    camera = CAMERA.scaled(320, 240)
    assert len(find_lines(blank, camera)) == 0
    assert manhattan_frames(find_lines(blank, camera)) == []
    lines = find_lines(drawn(segments(3, 40), any_turn(3), CAMERA), CAMERA)
    few = Lines(lines.normals[:7], lines.middles[:7], lines.weights[:7])
    assert len(lines) > len(few) == 7
    assert manhattan_frames(few) == []


def test_parallel_lines_alone_give_no_frame() -> None:
    normal = np.tile([0.0, 1.0, 0.0], (20, 1))
    assert manhattan_frames(Lines(normal, np.tile([0.0, 0.0, 1.0], (20, 1)), np.full(20, 0.1))) == []


def test_lines_are_planes_through_the_camera() -> None:
    lines = find_lines(drawn(segments(4, 40), any_turn(4), DISTORTED), DISTORTED)
    np.testing.assert_allclose(np.linalg.norm(lines.normals, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(lines.middles, axis=1), 1.0)
    np.testing.assert_allclose((lines.normals * lines.middles).sum(axis=1), 0.0, atol=1e-12)
    assert lines.weights.min() > 0


# Together they tilt by less than 45 degrees, so that no other direction of the room is nearer to vertical.
@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg"), [(0, 0), (0, 30), (0, -30), (40, 0), (-40, 0), (40, 15), (30, 30), (25, -30)]
)
@pytest.mark.parametrize("yaw_deg", [12, 40])
def test_gravity_is_found_in_an_image_held_upright(yaw_deg: float, pitch_deg: float, roll_deg: float) -> None:
    R = rotation_of(yaw_deg, pitch_deg, roll_deg)
    true = -R[2]
    assert np.degrees(np.arctan2(true[0], true[1])) == pytest.approx(roll_deg, abs=1e-6)
    assert np.degrees(np.arcsin(true[2])) == pytest.approx(pitch_deg)
    gravity_c = gravity_if_upright(drawn(segments(5, 60), R, CAMERA), CAMERA)
    assert gravity_c is not None
    assert np.linalg.norm(gravity_c) == pytest.approx(1.0)
    assert np.degrees(np.arccos(min(1.0, gravity_c @ true))) < WITHIN_DEG


def test_a_blank_image_gives_no_gravity() -> None:
    assert gravity_if_upright(np.full((480, 640, 3), 90, np.uint8), CAMERA) is None


def test_frames_differ_and_come_by_how_many_lines_run_along_them() -> None:
    R, turn = rotation_of(10, 5, 0), so3_exp(np.radians([20.0, 15.0, 35.0]))
    ends = np.concatenate([segments(6, 45), segments(7, 30) @ turn.T])
    frames = manhattan_frames(find_lines(drawn(ends, R, CAMERA), CAMERA), 2)
    assert len(frames) == 2
    assert off_deg(frames[0], R) < WITHIN_DEG
    assert off_deg(frames[1], turn.T @ R) < WITHIN_DEG
    assert frames[0].support.sum() > frames[1].support.sum()


def test_most_lines_of_a_room_support_its_directions() -> None:
    for seed in range(3):
        found = best(drawn(segments(seed, 40), any_turn(seed), CAMERA), CAMERA)
        assert found.support.min() >= 0
        # a line between two vanishing points runs along both and counts twice
        assert 0.5 < found.support.sum() < 1.2


@pytest.mark.parametrize(("width", "height"), [(320, 240), (1280, 960)])
def test_the_size_of_an_image_does_not_matter(width: int, height: int) -> None:
    R = rotation_of(20, 10, 5)
    camera = DISTORTED.scaled(width, height)
    found = best(drawn(segments(8, 40), R, camera), camera)
    usual = best(drawn(segments(8, 40), R, DISTORTED), DISTORTED)
    assert off_deg(found, R) < WITHIN_DEG
    assert off_deg(found, usual.axes) < WITHIN_DEG
