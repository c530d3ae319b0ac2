# SPDX-License-Identifier: Apache-2.0
"""The focal length by several passes, on passes whose memory and scatter are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from seen_scenes import CAMERA, scene

from slamdepth.backend.self_calibration import Prior, self_calibrate
from slamdepth.backend.self_calibration_passes import SCATTER, FocalLength, Pass, focal_length_of
from slamdepth.datasets.intrinsics import camera_of_view

TRUE = math.log(500.0)
GUESS, GUESS_SIGMA = math.log(554.0), 0.35


def chain(
    starts: list[float | None], memory: float, scatter: float = 0.0, seed: int = 0, true: float = TRUE
) -> list[Pass]:
    """Passes from ``starts``, logarithms; None starts where the pass before ended."""
    rng = np.random.default_rng(seed)
    passes: list[Pass] = []
    for start in starts:
        tracked = passes[-1].found_log_f if start is None else start
        noise = np.hypot(scatter, 0.005) * rng.normal() if scatter else 0.0
        found = true + memory * (tracked - true) + noise
        passes.append(Pass(tracked, found, 0.005))
    return passes


@pytest.mark.parametrize("memory", [0.0, 0.2, 0.5])
def test_passes_from_far_starts_give_the_focal_length_and_the_memory(memory: float) -> None:
    found = focal_length_of(chain([GUESS, None, TRUE + 0.35, None], memory), GUESS, GUESS_SIGMA)
    assert found.log_f == pytest.approx(TRUE, abs=2 * found.sigma)
    assert found.sigma < 0.05
    assert found.memory == pytest.approx(memory, abs=0.1)


def test_a_guess_that_is_found_again_may_only_be_believed() -> None:
    agreeing = chain([GUESS, None, None, None], 0.0, true=GUESS)
    assert focal_length_of(agreeing, GUESS, GUESS_SIGMA).sigma > 0.05
    tested = [*agreeing, *chain([GUESS + 0.35], 0.0, true=GUESS)]
    assert focal_length_of(tested, GUESS, GUESS_SIGMA).sigma < 0.025


def test_passes_that_give_back_what_they_were_given_say_nothing() -> None:
    passes = [Pass(start, start, 0.005) for start in (GUESS, GUESS + 0.35, GUESS - 0.35)]
    found = focal_length_of(passes, GUESS, GUESS_SIGMA)
    assert found.memory > 0.85
    assert found.sigma > 0.2


def test_windows_that_contradict_each_other_widen_the_interval() -> None:
    agreeing = chain([GUESS, None, GUESS + 0.35, None, None], 0.1)
    shifts = (0.2, -0.2, 0.15, -0.1, 0.1)
    contradicting = [
        Pass(one.tracked_log_f, one.found_log_f + shift, one.sigma)
        for one, shift in zip(agreeing, shifts, strict=True)
    ]
    sure = focal_length_of(agreeing, GUESS, GUESS_SIGMA)
    found = focal_length_of(contradicting, GUESS, GUESS_SIGMA)
    assert found.sigma > 3 * sure.sigma
    assert found.scatter > 3 * SCATTER


def test_nothing_seen_leaves_what_was_known() -> None:
    found = focal_length_of([], GUESS, GUESS_SIGMA)
    assert (found.log_f, found.sigma) == pytest.approx((GUESS, GUESS_SIGMA))


def test_a_named_focal_length_counts_as_a_measurement() -> None:
    passes = chain([GUESS, None], 0.0, 0.02)
    assert focal_length_of(passes, TRUE, 0.01).sigma < 0.01


def test_the_interval_covers_passes_of_any_memory_and_scatter() -> None:
    rng = np.random.default_rng(0)
    whitened = []
    for seed in range(400):
        true = GUESS + GUESS_SIGMA * rng.normal()
        scatter = SCATTER * math.exp(math.log(2.0) * rng.normal())
        passes = chain([GUESS, None, true + 0.35, None], rng.uniform(0.0, 0.99), scatter, seed, true)
        found = focal_length_of(passes, GUESS, GUESS_SIGMA)
        whitened.append((found.log_f - true) / found.sigma)
    off = np.abs(whitened)
    assert 0.6 < np.mean(off < 1) < 0.85
    assert np.mean(off < 2) > 0.93


def passes_over(path: str) -> FocalLength:
    """The focal length by three windows of a path, the last one adjusted from far off."""
    camera = guess = camera_of_view(640, 480, 60.0)
    prior = Prior(guess.fx, GUESS_SIGMA)
    passes = []
    for window, factor in enumerate((1.0, 1.0, math.exp(0.35))):
        tracked = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        found = self_calibrate(scene(path, seed=window), tracked, prior)
        passes.append(Pass(math.log(tracked.fx), math.log(found.camera.fx), found.sigma_log_f))
        camera = found.camera
    return focal_length_of(passes, math.log(guess.fx), GUESS_SIGMA)


@pytest.mark.parametrize("path", ["hand", "turning"])
def test_motion_that_turns_shows_the_focal_length(path: str) -> None:
    found = passes_over(path)
    assert found.sigma < 0.03
    assert abs(found.log_f - math.log(CAMERA.fx)) < 2 * found.sigma


@pytest.mark.parametrize("path", ["forward", "sideways"])
def test_motion_straight_ahead_or_aside_leaves_a_wide_interval(path: str) -> None:
    found = passes_over(path)
    assert found.sigma > 0.1
    assert abs(found.log_f - math.log(CAMERA.fx)) < 2 * found.sigma
