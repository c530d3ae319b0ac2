# SPDX-License-Identifier: Apache-2.0
"""Features: how many, where, and the same each time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slamdepth.config import FeatureConfig
from slamdepth.errors import ConfigError
from slamdepth.frontend.features import Features, create_extractor, spread
from slamdepth.types import Camera

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


def picture(seed: int = 0) -> np.ndarray:
    """Strong texture in one corner and weak texture elsewhere, as rooms have."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 1.5)
    noise /= noise.std()
    contrast = np.full((240, 320), 12.0)
    contrast[:100, :120] = 60.0
    return np.clip(128 + contrast * noise, 0, 255).astype(np.uint8)


def extract(gray: np.ndarray, **settings: object) -> Features:
    return create_extractor(FeatureConfig(**{"count": 300, **settings})).extract(gray, CAMERA)


def occupancy(px: np.ndarray, cell: int = 20) -> float:
    cells = {tuple(c) for c in np.floor(px / cell).astype(int)}
    return len(cells) / ((240 // cell) * (320 // cell))


def test_count_shapes_and_types() -> None:
    features = extract(picture())
    n = len(features)
    assert 250 <= n <= 300
    assert features.raw_px.shape == features.px.shape == (n, 2)
    assert features.px.dtype == features.raw_px.dtype == np.float64
    assert features.descriptors.shape == (n, 32)
    assert features.descriptors.dtype == np.uint8
    assert features.octave.shape == features.sigma_px.shape == (n,)
    assert features.octave.min() >= 0
    assert features.octave.max() < 8
    np.testing.assert_allclose(features.sigma_px, 1.2**features.octave)
    assert (features.raw_px >= 0).all()
    assert (features.raw_px < [320, 240]).all()


def test_spread_wider_than_opencv_does() -> None:
    gray = picture()
    ours = occupancy(extract(gray).raw_px)
    own = cv2.ORB_create(nfeatures=300, fastThreshold=7).detect(gray, None)
    theirs = occupancy(np.array([k.pt for k in own]))
    assert ours > 1.3 * theirs


def test_deterministic() -> None:
    first, second = extract(picture()), extract(picture())
    np.testing.assert_array_equal(first.raw_px, second.raw_px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    extractor = create_extractor(FeatureConfig(count=300))
    extractor.extract(picture(1), CAMERA)  # nothing stays behind of an earlier image
    np.testing.assert_array_equal(extractor.extract(picture(), CAMERA).descriptors, first.descriptors)


@pytest.mark.parametrize("grey", [0, 127, 255])
def test_a_blank_image_has_none(grey: int) -> None:
    features = extract(np.full((240, 320), grey, np.uint8))
    assert len(features) == 0
    assert features.px.shape == (0, 2)
    assert features.descriptors.shape == (0, 32)
    assert features.sigma_px.shape == (0,)


def test_an_image_too_small_for_a_patch_has_none() -> None:
    camera = Camera(24, 20, 20, 20, 11.5, 9.5)
    gray = np.random.default_rng(0).integers(0, 256, (20, 24), dtype=np.uint8)
    assert len(create_extractor(FeatureConfig()).extract(gray, camera)) == 0


def test_pixels_are_undistorted() -> None:
    camera = Camera(320, 240, 260, 260, 159.5, 119.5, (0.1, 0.02, 0.001, -0.001, 0.0))
    features = create_extractor(FeatureConfig(count=300)).extract(picture(), camera)
    np.testing.assert_allclose(features.px, camera.undistort_points(features.raw_px))
    assert np.abs(features.px - features.raw_px).max() > 1.0
    np.testing.assert_array_equal(features.raw_px, extract(picture()).raw_px)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"no feature is called 'surf'; known: .*orb"):
        create_extractor(FeatureConfig(name="surf"))


def test_the_best_of_every_cell_comes_first() -> None:
    px = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [15.0, 1.0], [1.0, 15.0], [2.0, 16.0]])
    response = np.array([0.9, 0.8, 0.7, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(spread(px, response, 3, 10.0), [0, 3, 5])
    np.testing.assert_array_equal(spread(px, response, 4, 10.0), [0, 1, 3, 5])
    np.testing.assert_array_equal(spread(px, response, 9, 10.0), np.arange(6))
    assert len(spread(np.zeros((0, 2)), np.zeros(0), 5, 10.0)) == 0


def test_spread_keeps_exactly_the_count() -> None:
    rng = np.random.default_rng(0)
    px, response = rng.uniform(0, 200, (500, 2)), rng.uniform(size=500)
    for count in (1, 17, 499):
        chosen = spread(px, response, count, 25.0)
        assert len(np.unique(chosen)) == count
        assert (np.diff(chosen) > 0).all() if count > 1 else True
