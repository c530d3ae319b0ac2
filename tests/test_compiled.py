# SPDX-License-Identifier: Apache-2.0
"""The compiled loops against their twins in NumPy and OpenCV."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamdepth.config import FeatureConfig
from slamdepth.frontend import compiled
from slamdepth.frontend.compiled import VARIABLE, loops
from slamdepth.frontend.extractors.orb import OrbExtractor
from slamdepth.frontend.features import Features, ScaleLevels
from slamdepth.frontend.matching import PixelGrid, match_all
from slamdepth.frontend.metric import ORB, DescriptorMetric, Hamming, UnitL2, hamming_nearest
from slamdepth.frontend.moving import moving_share
from slamdepth.frontend.orb_pattern import orb_pattern
from slamdepth.frontend.patch_alignment import ImagePyramid, Templates, _align, align
from slamdepth.frontend.pose import pose_covariance, refine_pose
from slamdepth.geometry import project, se3_exp, transform
from slamdepth.mapping.landmarks import Landmarks
from slamdepth.tracking.landmark_search import SearchWindow, match_landmarks, visible_landmarks
from slamdepth.types import Camera

pytest.importorskip("numba")

CAMERA = Camera(640, 480, 520.0, 515.0, 322.0, 238.0)
LEVELS = ScaleLevels(1.2, 8)


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Switches to NumPy where a test calls ``setenv(VARIABLE, "0")`` on it."""
    monkeypatch.setenv(VARIABLE, "1")
    return monkeypatch


def noise(shape: tuple[int, int], contrast: float = 40.0, blur: float = 1.5, seed: int = 0) -> np.ndarray:
    of_pixels = np.random.default_rng(seed).normal(size=shape)
    smooth = np.asarray(cv2.GaussianBlur(of_pixels, (0, 0), blur), np.float64)
    image: np.ndarray = np.clip(128 + contrast * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return image


def world(seed: int, metric: DescriptorMetric = ORB) -> tuple[Landmarks, Features, np.ndarray]:
    """400 landmarks, an image of most of them among others, and the pose that it was taken from."""
    rng = np.random.default_rng(seed)
    n, more = 400, 200
    T = se3_exp(rng.normal(size=6) * 0.1)
    own = Landmarks.empty(n, np.zeros((0, metric.empty().shape[1]), metric.empty().dtype))
    own.position_w[:] = np.c_[rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(-0.5, 6, n)]
    A = rng.normal(size=(n, 3, 3)) * rng.choice([0.001, 0.02, 0.2], n)[:, None, None]
    own.covariance_w[:] = A @ np.swapaxes(A, 1, 2)
    toward = own.position_w + rng.normal(size=(n, 3)) * 0.7
    own.distance_m[:] = np.linalg.norm(toward, axis=1)
    own.direction_w[:] = toward / own.distance_m[:, None]
    own.octave[:] = rng.integers(0, 8, n)
    bits = rng.integers(0, 256, (n + more, own.descriptor.shape[1]))
    flipped = bits ^ (1 << rng.integers(0, 8, bits.shape)) * (rng.random(bits.shape) < 0.4)
    if isinstance(metric, UnitL2):
        bits, flipped = (
            x / np.linalg.norm(x, axis=1, keepdims=True) for x in (bits - 127.5, flipped - 127.5)
        )
    own.descriptor[:] = bits[:n]
    px, _ = project(CAMERA, transform(T, own.position_w))
    px = np.r_[px + rng.normal(size=(n, 2)), rng.uniform(0, 480, (more, 2))].clip(0, [639, 479])
    octave = np.r_[own.octave, rng.integers(0, 8, more)].astype(np.int64)
    described = flipped.astype(own.descriptor.dtype)
    features = Features(px, px, octave, LEVELS.sigma_px(octave), described, metric)
    return own.read_only(n), features, T


@pytest.mark.parametrize("seed", range(5))
def test_the_same_landmarks_are_visible(seed: int, without_numba: pytest.MonkeyPatch) -> None:
    landmarks, _, T = world(seed)
    ids = np.arange(0, 400, 2)
    fast = visible_landmarks(CAMERA, LEVELS, landmarks, T, ids)
    without_numba.setenv(VARIABLE, "0")
    slow = visible_landmarks(CAMERA, LEVELS, landmarks, T, ids)
    assert 20 < len(slow.ids) < 180
    np.testing.assert_array_equal(fast.ids, slow.ids)
    np.testing.assert_array_equal(fast.octave, slow.octave)
    np.testing.assert_allclose(fast.px, slow.px, rtol=1e-12)
    np.testing.assert_allclose(fast.covariance_px, slow.covariance_px, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("metric", [ORB, Hamming(64, 120, 90), Hamming(61, 120, 90), UnitL2(128, 0.7, 0.5)])
@pytest.mark.parametrize("seed", range(3))
def test_the_same_features_match(
    seed: int, metric: DescriptorMetric, without_numba: pytest.MonkeyPatch
) -> None:
    landmarks, features, T = world(seed, metric)
    visible = visible_landmarks(CAMERA, LEVELS, landmarks, T, np.arange(400))
    for window in (SearchWindow(2.0, 20.0), SearchWindow(30.0, 200.0, 1.0)):

        def found(window: SearchWindow = window) -> tuple[np.ndarray, ...]:
            limit = metric.max_distance
            return match_landmarks(
                visible, landmarks, features, LEVELS, window, max_distance=limit, ratio=0.85
            )

        without_numba.setenv(VARIABLE, "1")
        fast = found()
        without_numba.setenv(VARIABLE, "0")
        slow = found()
        assert len(slow[0]) > 20
        for a, b in zip(fast, slow, strict=True):
            np.testing.assert_array_equal(a, b)


def test_nothing_matches_nothing() -> None:
    landmarks, features, T = world(0)
    none = np.zeros(0, np.int64)
    visible = visible_landmarks(CAMERA, LEVELS, landmarks, T, none)
    assert len(visible.ids) == 0
    window = SearchWindow(2.0, 20.0)
    for expected in (visible, visible_landmarks(CAMERA, LEVELS, landmarks, T, np.arange(400))):
        of = Features(np.zeros((0, 2)), np.zeros((0, 2)), none, np.zeros(0), ORB.empty())
        for seen in (of, features):
            ids, at, _ = match_landmarks(
                expected, landmarks, seen, LEVELS, window, max_distance=64, ratio=0.8
            )
            assert len(ids) == len(at)
            assert len(ids) == 0 or (len(seen) > 0 and len(expected.ids) > 0)


@pytest.mark.parametrize("count", [1, 2, 700])
def test_pixels_are_in_the_same_cells(count: int, without_numba: pytest.MonkeyPatch) -> None:
    px = np.random.default_rng(count).uniform(-20, 4000, (count, 2))
    fast = PixelGrid(px)
    without_numba.setenv(VARIABLE, "0")
    slow = PixelGrid(px)
    assert (fast.cell, fast.columns, fast.rows) == (slow.cell, slow.columns, slow.rows)
    for name in ("low", "order", "starts"):
        np.testing.assert_array_equal(getattr(fast, name), getattr(slow, name))


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_is_refined_alike(seed: int, without_numba: pytest.MonkeyPatch) -> None:
    landmarks, features, T = world(seed)
    at = np.flatnonzero(transform(T, landmarks.position_w)[:, 2] > 0.3)
    given = (landmarks.position_w[at], landmarks.covariance_w[at], features.px[at], features.sigma_px[at])
    start = se3_exp(np.random.default_rng(seed).normal(size=6) * 0.02) @ T
    fast, fast_covariance = refine_pose(CAMERA, start, *given), pose_covariance(CAMERA, T, *given)
    without_numba.setenv(VARIABLE, "0")
    slow, slow_covariance = refine_pose(CAMERA, start, *given), pose_covariance(CAMERA, T, *given)
    np.testing.assert_allclose(fast.T_camera_world, slow.T_camera_world, atol=1e-9)
    np.testing.assert_array_equal(fast.inliers, slow.inliers)
    np.testing.assert_allclose(fast.information, slow.information, rtol=1e-6, atol=1e-3)
    assert fast_covariance is not None
    assert slow_covariance is not None
    np.testing.assert_allclose(fast_covariance, slow_covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_same_share_moves(seed: int, without_numba: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    _, now, _ = world(seed)
    px = now.px + rng.normal(size=2) * 3
    px[:60] += [14.0, -9.0]  # what moves, in one corner
    px[:60] = px[:60] % 100
    before = replace(now, px=px, raw_px=px)
    free = np.flatnonzero(rng.random(len(now)) < 0.8)
    T = se3_exp(rng.normal(size=6) * 0.01)
    asked = (CAMERA, before, now, free, free[::-1][: len(free) // 2 * 2].copy(), now.px[:50], T, 3.0)
    fast = moving_share(*asked)
    without_numba.setenv(VARIABLE, "0")
    assert fast is not None
    assert fast == moving_share(*asked)


@pytest.mark.parametrize("size", [(1, 2), (40, 300), (300, 40), (2, 1), (0, 5)])
def test_whole_images_match_alike(size: tuple[int, int], without_numba: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(size[0])
    b = rng.integers(0, 4, (size[1], 32)).astype(np.uint8)
    a = np.r_[b[: size[0] // 2], rng.integers(0, 4, (size[0] - size[0] // 2, 32)).astype(np.uint8)][: size[0]]
    fast = match_all(a, b, ratio=0.9), hamming_nearest(a, b)
    without_numba.setenv(VARIABLE, "0")
    slow = match_all(a, b, ratio=0.9), hamming_nearest(a, b)
    for x, y in zip((*fast[0], fast[1]), (*slow[0], slow[1]), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype


IMAGES = {
    "texture": noise((480, 640)),
    "fine texture": noise((480, 640), 60.0, 0.7),
    "faint texture": noise((480, 640), 4.0),
    "half faint": np.hstack([noise((480, 480), 5.0), noise((480, 160), 25.0)]),
    "large": noise((720, 1280), 30.0),
    "upright": noise((640, 360), 30.0),
    "small": noise((90, 120)),
    "smaller than the border": noise((60, 60)),
    "grey": np.full((480, 640), 90, np.uint8),
    "checkerboard": np.kron(np.indices((12, 16)).sum(0) % 2, np.full((40, 40), 200)).astype(np.uint8),
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize(
    "config",
    [FeatureConfig(), FeatureConfig(count=300, scale_factor=1.5, levels=4), FeatureConfig(count=3000)],
)
def test_orb_is_opencvs_to_the_last_bit(name: str, config: FeatureConfig) -> None:
    extractor = OrbExtractor(config)
    assert extractor.is_compiled
    fast, slow = extractor.found(IMAGES[name]), extractor.found_by_opencv(IMAGES[name])
    for n in range(3):
        np.testing.assert_array_equal(fast[n], slow[n])
        assert fast[n].dtype == slow[n].dtype


def test_any_image_may_follow_any_other() -> None:
    extractor = OrbExtractor(FeatureConfig())
    order = (
        "upright",
        "faint texture",
        "faint texture",
        "texture",
        "large",
        "grey",
        "faint texture",
        "texture",
    )
    for name in (*order, *IMAGES, *reversed(IMAGES)):
        fast, slow = extractor.found(IMAGES[name]), extractor.found_by_opencv(IMAGES[name])
        for n in range(3):
            np.testing.assert_array_equal(fast[n], slow[n])


def test_an_order_that_is_not_known_is_left_to_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    extractor = OrbExtractor(FeatureConfig(count=300))
    fast = loops()
    assert fast is not None
    monkeypatch.setattr(fast.retain, "best_of_levels", lambda *_: (False, np.zeros(0, np.int64)))
    fast_found, slow = extractor.found(IMAGES["texture"]), extractor.found_by_opencv(IMAGES["texture"])
    for n in range(3):
        np.testing.assert_array_equal(fast_found[n], slow[n])


def test_the_pattern_is_within_a_patch() -> None:
    pattern = orb_pattern()
    assert pattern.shape == (512, 2)
    assert np.abs(pattern).max() <= 15
    assert (pattern[::2] != pattern[1::2]).any(axis=1).all()
    assert len(np.unique(pattern.reshape(256, 4), axis=0)) == 256


def test_another_orb_is_used_as_it_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("slamdepth.frontend.compiled_orb.orb_pattern", lambda: np.ones((512, 2), np.float32))
    monkeypatch.setattr("slamdepth.frontend.extractors.orb._agreed", {})
    with caplog.at_level("INFO"):
        extractor = OrbExtractor(FeatureConfig())
    assert not extractor.is_compiled
    assert "differs from the compiled one" in caplog.text


@pytest.mark.parametrize("size", [(480, 640), (40, 30), (12, 9)])
def test_patches_are_aligned_as_without_compiled_loops(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    grey = noise(size, blur=2.0)
    shifted = cv2.warpAffine(grey, np.array([[1.0, 0.02, 0.4], [-0.02, 1.0, -0.3]]), size[::-1])
    pyramids = [ImagePyramid(np.dstack([one] * 3).astype(np.uint8)) for one in (grey, shifted)]
    px = rng.uniform(-2, np.array(size[::-1]) + 2, (300, 2))
    templates = Templates.of(pyramids[0], px, rng.uniform(0.7, 6.0, 300))
    warp = np.eye(2) + rng.normal(0.0, 0.05, (300, 2, 2))
    fast, slow = align(pyramids[1], templates, warp, px), _align(pyramids[1], templates, warp, px)
    fits = templates.is_usable & (slow[1] > 0.85)
    assert fits.sum() > 10
    np.testing.assert_allclose(fast[0][fits], slow[0][fits], atol=0.05)  # remap's places may be coarse
    np.testing.assert_allclose(fast[1][fits], slow[1][fits], atol=0.02)
    assert (fast[1][templates.is_usable & (slow[1] < 0.8)] < 0.85).all()


def test_a_patch_that_nothing_is_known_of_fits_nowhere() -> None:
    pyramid = ImagePyramid(np.dstack([noise((60, 80))] * 3).astype(np.uint8))
    px = np.array([[40.0, 30.0], [np.nan, 30.0], [np.inf, 30.0], [40.0, 30.0], [1e300, -1e300]])
    warp = np.broadcast_to(np.eye(2), (5, 2, 2)).copy()
    warp[3] = np.nan
    templates = Templates.of(pyramid, np.broadcast_to(px[:1], (5, 2)), np.ones(5))
    found, correlation = align(pyramid, templates, warp, px)
    assert found.shape == (5, 2)
    assert correlation[0] > 0.99
    assert not (correlation[1:] > 0.85).any()


def test_a_variable_turns_compiled_loops_off(without_numba: pytest.MonkeyPatch) -> None:
    assert loops() is not None
    without_numba.setenv(VARIABLE, "0")
    assert loops() is None
    assert not OrbExtractor(FeatureConfig()).is_compiled


def test_a_numba_that_cannot_be_imported_is_done_without(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert loops() is not None
    monkeypatch.delattr(compiled, "visible")
    monkeypatch.setitem(sys.modules, "slamdepth.frontend.compiled.visible", None)
    assert compiled._loops.__wrapped__() is None
    assert "numba cannot be used" in caplog.text


def test_loops_are_compiled_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    from slamdepth.frontend.compiled import jit

    def njit(*, cache: bool = False, **more: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr("numba.njit", njit)
    assert jit.compiled(abs) is abs


def test_a_run_is_as_accurate_with_and_without(tiny_room: Path, without_numba: pytest.MonkeyPatch) -> None:
    from slamdepth.datasets import open_dataset
    from slamdepth.depth.registry import create_depth_model
    from slamdepth.tracking import create_tracker

    dataset = open_dataset(tiny_room)
    poses = []
    for value in ("1", "0"):
        without_numba.setenv(VARIABLE, value)
        with create_tracker(dataset.camera, create_depth_model("sensor")) as tracker:
            for index in range(len(dataset)):
                tracker.step(dataset.read(index, with_depth=True))
            poses.append(tracker.finish().trajectory.T_world_camera)
    assert len(poses[0]) == len(poses[1]) == len(dataset)
    np.testing.assert_allclose(poses[0][:, :3, 3], poses[1][:, :3, 3], atol=5e-3)
