# SPDX-License-Identifier: Apache-2.0
"""A rolling shutter: rows are exposed one after the other while the camera moves."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tracking_scene import CAMERA, CONFIG, Run, ate_m, frames, played

from slamdepth.config import Config, ShutterConfig
from slamdepth.depth.sensor import SensorDepth
from slamdepth.frontend.features import Features
from slamdepth.frontend.rolling_shutter import at_middle_row, px_per_readout_s, row_phase, velocity_between
from slamdepth.geometry import backproject, invert, project, se3_exp, so3_exp, transform
from slamdepth.mapping.map import Map
from slamdepth.mapping.placement import Placement
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.tracking import create_tracker
from slamdepth.tracking.frame_log import FrameLog
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.types import Camera, Frame

PINHOLE = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)
READOUT_S = 0.03

speed = st.floats(-0.6, 0.6)
turn = st.floats(-1.0, 1.0)  # rad/s
velocities = st.tuples(speed, speed, speed, turn, turn, turn).map(np.array)


def moved(velocity: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """``T_world_camera`` after so many seconds from the origin, velocity in the camera's own axes."""
    steps = 64
    T = np.eye(4)
    for _ in range(steps):
        T = T @ se3_exp(velocity * dt / steps)
    return T


def seen_rolling(
    velocity: NDArray[np.float64], points_w: NDArray[np.float64], readout_s: float
) -> NDArray[np.float64]:
    """Pixels of points, each at the time its row is read: found by fixed point iteration."""
    out = []
    for X in points_w:
        px = project(PINHOLE, X[None])[0][0]
        for _ in range(20):
            dt = readout_s * row_phase(px[None], PINHOLE)[0]
            px = project(PINHOLE, transform(invert(moved(velocity, dt)), X[None]))[0][0]
        out.append(px)
    return np.array(out)


@given(velocities)
@settings(max_examples=25, deadline=None)
def test_rolling_pixels_go_back_to_where_the_middle_row_saw_them(velocity: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(0)
    corrected = rng.uniform((40, 40), (600, 440), (8, 2))
    z = rng.uniform(0.8, 4.0, 8)
    rolling = seen_rolling(velocity, backproject(PINHOLE, corrected, z), READOUT_S)
    # the depth in the row's own camera differs by millimetres, which is of second order
    back = at_middle_row(PINHOLE, rolling, row_phase(rolling, PINHOLE), 1.0 / z, velocity, READOUT_S)
    off = np.linalg.norm(rolling - corrected, axis=1)
    assert np.linalg.norm(back - corrected, axis=1).max() < 0.02 + 0.05 * off.max()


def test_a_camera_at_rest_and_a_global_shutter_change_nothing() -> None:
    px = np.array([[10.0, 20.0], [600.0, 470.0]])
    phase, near = row_phase(px, PINHOLE), np.ones(2)
    np.testing.assert_allclose(at_middle_row(PINHOLE, px, phase, near, np.zeros(6), 0.03), px)
    np.testing.assert_allclose(at_middle_row(PINHOLE, px, phase, near, np.ones(6), 0.0), px)


def test_upper_rows_come_first_and_the_middle_row_stays() -> None:
    px = np.array([[320.0, 0.0], [320.0, 240.0], [320.0, 480.0]])
    np.testing.assert_allclose(row_phase(px, PINHOLE), [-0.5, 0.0, 0.5])
    # turning right moves the image left: the first row, read earlier, saw things farther right
    turning = np.array([0, 0, 0, 0, 1.0, 0])
    back = at_middle_row(PINHOLE, px, row_phase(px, PINHOLE), np.zeros(3), turning, READOUT_S)
    assert back[0, 0] < px[0, 0]
    np.testing.assert_allclose(back[1], px[1])
    assert back[2, 0] > px[2, 0]


def test_the_rows_of_an_upright_image_are_its_columns() -> None:
    upright = Camera(480, 640, 510.0, 520.0, 241.0, 319.0)
    px = np.array([[0.0, 600.0], [240.0, 10.0], [480.0, 320.0]])
    np.testing.assert_allclose(row_phase(px, upright), [-0.5, 0.0, 0.5])


@given(velocities, st.floats(0.01, 0.1))
@settings(max_examples=50, deadline=None)
def test_velocity_between_two_poses_is_the_velocity_that_leads_there(
    velocity: NDArray[np.float64], interval_s: float
) -> None:
    T = invert(moved(velocity, interval_s))
    found = velocity_between(np.eye(4), T, interval_s)
    np.testing.assert_allclose(found, velocity, atol=2e-3 + 0.02 * interval_s)
    anywhere = se3_exp(np.array([0.3, -0.2, 0.5, 0.4, -0.7, 0.2]))
    np.testing.assert_allclose(velocity_between(anywhere, T @ anywhere, interval_s), found, atol=1e-9)


def test_the_rate_is_the_derivative() -> None:
    rng = np.random.default_rng(1)
    px, velocity = rng.uniform((0, 0), (640, 480), (20, 2)), rng.normal(size=6)
    phase, inverse = row_phase(px, PINHOLE), rng.uniform(0.2, 1.0, 20)
    rate = px_per_readout_s(PINHOLE, px, phase, inverse, velocity)
    up, down = (at_middle_row(PINHOLE, px, phase, inverse, velocity, s * 1e-4) for s in (1, -1))
    np.testing.assert_allclose(rate, (up - down) / 2e-4, rtol=0.02, atol=0.5)


@pytest.mark.parametrize(
    ("change_s", "sigma_s", "readout_s"),
    [
        (0.02, 0.001, 0.02),
        (0.002, 0.001, 0.0),  # within its uncertainty: global
        (0.02, 0.01, 0.0),  # too uncertain
        (0.2, 0.001, 0.0),  # impossible
        (0.04, 0.001, 1 / 30),  # longer than a frame
        (-0.02, 0.001, -0.02),  # a camera hung upside down
    ],
)
def test_a_readout_time_is_kept_where_it_is_certain_and_possible(
    change_s: float, sigma_s: float, readout_s: float
) -> None:
    shutter = RollingShutter(PINHOLE, ShutterConfig(), Map())
    assert shutter.update(change_s, sigma_s) is (readout_s != 0)
    assert shutter.readout_s == pytest.approx(readout_s)
    assert shutter.is_active is (readout_s != 0)


def test_a_given_readout_time_is_not_estimated() -> None:
    given = RollingShutter(PINHOLE, ShutterConfig(readout_ms=18.0), Map())
    assert given.readout_s == pytest.approx(0.018)
    assert not given.is_estimated
    assert not given.is_due(1000)
    unknown = RollingShutter(PINHOLE, ShutterConfig(), Map())
    assert unknown.is_estimated
    assert [n for n in range(1, 40) if unknown.is_due(n)] == [10, 15, 22, 33]


def tracked(frames: list[Frame], config: Config = CONFIG) -> Reconstruction:
    return Run(frames, SensorDepth(), config).finish()


def upright(frame: Frame) -> Frame:
    """The frame as a camera held upright takes it, turned a quarter to the left."""
    camera = replace(
        CAMERA,
        width=CAMERA.height,
        height=CAMERA.width,
        fx=CAMERA.fy,
        fy=CAMERA.fx,
        cx=CAMERA.cy,
        cy=CAMERA.width - 1 - CAMERA.cx,
    )
    assert frame.depth_m is not None
    return replace(
        frame,
        image_rgb=np.ascontiguousarray(np.rot90(frame.image_rgb)),
        depth_m=np.ascontiguousarray(np.rot90(frame.depth_m)),
        camera=camera,
    )


_SHAKE_RAD, _SHAKE_HZ = np.radians(2.5), 1.7


def shaken(frame: Frame, readout_s: float) -> Frame:
    """The frame as a shaking camera with a rolling shutter sees it: every row turned by its own time."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    t = frame.timestamp_s + readout_s * (v / CAMERA.height - 0.5)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    R = so3_exp(_shake(t.ravel())).reshape(*t.shape, 3, 3)
    rays = np.einsum("hwij,hwj->hwi", R, rays)
    at_u = (CAMERA.fx * rays[..., 0] / rays[..., 2] + CAMERA.cx).astype(np.float32)
    at_v = (CAMERA.fy * rays[..., 1] / rays[..., 2] + CAMERA.cy).astype(np.float32)
    image = cv2.remap(frame.image_rgb, at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    assert frame.depth_m is not None
    depth = cv2.remap(frame.depth_m, at_u, at_v, cv2.INTER_NEAREST, borderValue=0) / rays[..., 2]
    return replace(frame, image_rgb=np.asarray(image, np.uint8), depth_m=depth.astype(np.float32))


def _shake(t: NDArray[np.float64]) -> NDArray[np.float64]:
    phase = 2 * np.pi * _SHAKE_HZ * t
    turns = np.stack([np.sin(phase), np.cos(1.3 * phase), 0.6 * np.sin(0.7 * phase + 1)], -1)
    return np.asarray(_SHAKE_RAD * turns)


@pytest.fixture(scope="module")
def rolling_frames() -> list[Frame]:
    return frames(change=lambda frame: shaken(frame, READOUT_S))


@pytest.fixture(scope="module")
def found(rolling_frames: list[Frame]) -> Reconstruction:
    """The reconstruction with a readout time estimated by the tracker."""
    return tracked(rolling_frames)


def test_estimating_the_readout_time_improves_the_trajectory(
    rolling_frames: list[Frame], found: Reconstruction
) -> None:
    assert found.statistics.readout_sigma_s is not None
    # seven keyframes of 320 x 240: noisy velocities make it too short
    assert 0.6 * READOUT_S < (found.statistics.readout_s or 0.0) < 1.1 * READOUT_S
    ignoring = Config.from_dict({**CONFIG.model_dump(), "shutter": {"readout_ms": 0}})
    ignored = tracked(rolling_frames, ignoring)
    assert ignored.statistics.readout_s == 0.0
    assert ignored.statistics.readout_sigma_s is None
    assert ate_m(found.trajectory) < 0.5 * ate_m(ignored.trajectory)


def test_a_phone_held_upright_rolls_along_the_width(
    rolling_frames: list[Frame], found: Reconstruction
) -> None:
    turned = [upright(frame) for frame in rolling_frames]
    tracker = create_tracker(turned[0].camera, SensorDepth(), CONFIG)
    for frame in turned:
        tracker.step(frame)
    upright_found = tracker.finish()
    assert 0.6 * READOUT_S < (upright_found.statistics.readout_s or 0.0) < 1.1 * READOUT_S
    # the camera turned, its path did not
    assert ate_m(upright_found.trajectory) < 2.0 * ate_m(found.trajectory)


def test_a_global_shutter_is_recognised() -> None:
    found = tracked(frames(change=lambda frame: shaken(frame, 0.0)))
    assert abs(found.statistics.readout_s or 0.0) < 0.004


@pytest.mark.parametrize("cut", [30, 44])
def test_a_cut_in_the_recording_is_no_motion(rolling_frames: list[Frame], cut: int) -> None:
    """The velocity of a jump from one place to another would displace all rows."""
    config = Config.from_dict({**CONFIG.model_dump(), "shutter": {"readout_ms": 1e3 * READOUT_S}})
    run = Run(played([*rolling_frames[:cut], *rolling_frames[:16]]), SensorDepth(), config)
    for before, after in zip(run.results[:16], run.results[cut:], strict=True):
        assert before.T_world_camera is not None
        assert after.T_world_camera is not None
        np.testing.assert_allclose(after.T_world_camera, before.T_world_camera, atol=0.04)
    made = run.finish().trajectory.T_world_camera
    np.testing.assert_allclose(made[cut:], made[:16], atol=0.03)


def test_a_frame_that_no_motion_leads_to_is_as_fast_as_the_frames_after_it() -> None:
    """It was placed without a velocity, so its own place is not to be trusted for one."""
    map_ = Map()
    log = FrameLog(PINHOLE, map_)
    velocity = np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.3])
    off = se3_exp(np.array([0.03, 0.02, 0.0, 0.0, 0.02, 0.0]))
    for n in range(3):
        T_camera_world = invert(moved(velocity, n / 30))
        if n == 0:
            T_camera_world = off @ T_camera_world
            frame = Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), PINHOLE)
            map_.add_keyframe(frame, no_features(), T_camera_world, np.zeros(0, np.int64))
        placement = Placement(T_camera_world, np.zeros(0, np.int64))
        log.add(n / 30, no_features(), placement, n == 0, follows_motion=n != 0)
    log.refresh_velocities()
    np.testing.assert_allclose(map_.keyframes[0].velocity, velocity, atol=0.01)


def no_features() -> Features:
    nothing = np.zeros((0, 2))
    return Features(nothing, nothing, np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 32), np.uint8))
