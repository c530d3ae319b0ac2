# SPDX-License-Identifier: Apache-2.0
"""Focal length and distortion from the motion, on scenes whose camera is known exactly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from seen_scenes import CAMERA, IMAGES, scene

from slamdepth.backend.self_calibration import Prior, SelfCalibration, self_calibrate
from slamdepth.backend.sights import Sights
from slamdepth.datasets.intrinsics import camera_of_view
from slamdepth.types import Camera

GUESS = camera_of_view(640, 480, 60.0)
PRIOR = Prior(GUESS.fx, 0.35)


def error(found: SelfCalibration, camera: Camera = CAMERA) -> float:
    """Of the logarithm of the focal length."""
    return math.log(found.camera.fx / camera.fx)


def test_an_exact_scene_gives_the_camera_exactly() -> None:
    found = self_calibrate(scene(noise_px=0.0), GUESS, PRIOR)
    assert found.converged
    assert found.camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    assert found.camera.distortion[:2] == pytest.approx(CAMERA.distortion[:2], abs=5e-3)
    assert (found.camera.cx, found.camera.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=0.5)


@pytest.mark.parametrize("view_deg", [40.0, 60.0, 90.0])
def test_the_first_guess_does_not_matter(view_deg: float) -> None:
    guess = camera_of_view(640, 480, view_deg)
    found = self_calibrate(scene(), guess, PRIOR)
    again = self_calibrate(scene(), CAMERA, PRIOR)
    assert found.camera.fx == pytest.approx(again.camera.fx, rel=2e-3)


@pytest.mark.parametrize("path", ["hand", "turning"])
def test_the_deviation_is_that_of_many_noisy_scenes(path: str) -> None:
    found = [self_calibrate(scene(path, seed=seed), GUESS, PRIOR) for seed in range(12)]
    whitened = np.array([error(one) / one.sigma_log_f for one in found])
    assert np.mean(np.abs(whitened) < 1) > 0.4
    assert np.mean(np.abs(whitened) < 2.5) > 0.9
    assert 0.6 < np.sqrt(np.mean(whitened**2)) < 1.6
    assert max(one.sigma_log_f for one in found) < 0.03


@pytest.mark.parametrize("path", ["forward", "sideways"])
def test_motion_that_shows_little_of_the_focal_length_says_so(path: str) -> None:
    sure = self_calibrate(scene("hand"), GUESS, PRIOR)
    found = self_calibrate(scene(path), GUESS, PRIOR)
    assert found.sigma_log_f > 3 * sure.sigma_log_f
    assert abs(error(found)) < 3 * found.sigma_log_f


def test_a_camera_that_stands_still_leaves_the_guess() -> None:
    sights = scene("hand")
    still = replace(sights, T_camera_world=np.tile(np.eye(4), (IMAGES, 1, 1)))
    at = sights.obs_camera == 0
    first = dict(zip(sights.obs_point[at].tolist(), sights.raw_px[at], strict=True))
    seen = np.array([point in first for point in sights.obs_point.tolist()])
    rng = np.random.default_rng(0)
    px = np.array([first[point] for point in sights.obs_point[seen].tolist()])
    still = replace(
        still,
        obs_camera=sights.obs_camera[seen],
        obs_point=sights.obs_point[seen],
        raw_px=px + 0.4 * rng.normal(size=px.shape),
        sigma_px=sights.sigma_px[seen],
        px_rate=sights.px_rate[seen],
    )
    assert self_calibrate(still, GUESS, PRIOR).sigma_log_f > 0.05


def test_a_nominal_focal_length_holds_where_the_motion_says_little() -> None:
    found = self_calibrate(scene("forward"), CAMERA, Prior(CAMERA.fx, 0.02))
    assert found.sigma_log_f < 0.025
    assert abs(error(found)) < 0.05


def test_wrong_matches_do_not_matter() -> None:
    sights = scene()
    rng = np.random.default_rng(0)
    wrong = rng.random(len(sights.raw_px)) < 0.05
    raw_px = sights.raw_px + wrong[:, None] * rng.uniform(-40, 40, sights.raw_px.shape)
    found = self_calibrate(replace(sights, raw_px=raw_px), GUESS, PRIOR)
    assert abs(error(found)) < 3 * found.sigma_log_f < 0.06


def test_errors_that_a_landmark_repeats_widen_the_interval() -> None:
    sights = scene(noise_px=0.1)
    shift = np.random.default_rng(0).normal(size=(len(sights.points_w), 2))
    drift = shift[sights.obs_point] * (sights.obs_camera[:, None] > IMAGES / 2)
    found = self_calibrate(replace(sights, raw_px=sights.raw_px + drift), GUESS, PRIOR)
    assert found.sigma_log_f > 1.2 * found.naive_sigma_log_f


def test_maps_without_a_common_frame_are_adjusted_together() -> None:
    parts = [scene(seed=1), scene(seed=2)]
    found = self_calibrate(Sights.joined(parts), GUESS, PRIOR)
    alone = self_calibrate(parts[0], GUESS, PRIOR)
    assert found.sigma_log_f < alone.sigma_log_f
    assert abs(error(found)) < 3 * found.sigma_log_f


def test_the_readout_time_is_found_with_it() -> None:
    sights = scene(noise_px=0.2)
    rng = np.random.default_rng(3)
    per_image = rng.normal(size=(IMAGES, 2)) * 200
    rate = per_image[sights.obs_camera] * (sights.raw_px[:, 1:] / 480 - 0.5)
    rolled = replace(sights, raw_px=sights.raw_px - 0.02 * rate, px_rate=rate)
    found = self_calibrate(rolled, GUESS, replace(PRIOR, readout_s=0.02))
    assert found.readout_s == pytest.approx(0.02, abs=0.003)


def test_the_same_sights_give_the_same_camera() -> None:
    assert self_calibrate(scene(), GUESS, PRIOR) == self_calibrate(scene(), GUESS, PRIOR)
