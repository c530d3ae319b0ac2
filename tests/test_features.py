# SPDX-License-Identifier: Apache-2.0
"""What every extractor promises: count, spread, uncertainty and determinism."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from feature_networks import write_aliked

from slamdepth.config import FeatureConfig
from slamdepth.errors import ConfigError, TrackingError, WeightsError
from slamdepth.frontend.features import (
    FeatureExtractor,
    Features,
    ScaleLevels,
    create_extractor,
    feature_names,
    feature_weights,
    register_extractor,
)
from slamdepth.frontend.keypoints import spread
from slamdepth.frontend.metric import Hamming, UnitL2
from slamdepth.types import Camera

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


def image(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Strong texture in one corner and weak texture elsewhere, as rooms have."""
    rng = np.random.default_rng(seed)
    noise = np.asarray(cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 1.5), np.float64)
    noise /= noise.std()
    contrast = np.full(shape, 12.0)
    contrast[:100, :120] = 60.0
    return np.clip(128 + contrast * noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_aliked(tmp_path_factory.mktemp("networks") / "aliked.onnx")


@pytest.fixture(params=feature_names())
def extractor(request: pytest.FixtureRequest, network: Path) -> FeatureExtractor:
    """Every feature that this OpenCV can make."""
    weights = str(network) if request.param == "aliked" else None
    try:
        return create_extractor(FeatureConfig(name=request.param, count=300, weights=weights))
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture
def orb() -> FeatureExtractor:
    return create_extractor(FeatureConfig(count=300))


def occupancy(px: np.ndarray, cell: int = 20) -> float:
    cells = {tuple(c) for c in np.floor(px / cell).astype(int)}
    return len(cells) / ((240 // cell) * (320 // cell))


def test_count_shapes_and_types(extractor: FeatureExtractor) -> None:
    features = extractor.extract(image(), CAMERA)
    n = len(features)
    assert 150 <= n <= 300
    assert features.raw_px.shape == features.px.shape == (n, 2)
    assert features.px.dtype == features.raw_px.dtype == np.float64
    assert features.octave.shape == features.sigma_px.shape == (n,)
    assert features.octave.min() >= 0
    assert features.octave.max() < extractor.levels.count
    assert (features.raw_px >= -0.5).all()
    assert (features.raw_px < [319.5, 239.5]).all()
    assert features.descriptors.flags.c_contiguous
    assert len(np.unique(features.raw_px, axis=0)) > 0.9 * n


def test_descriptors_are_what_the_metric_compares(extractor: FeatureExtractor) -> None:
    features = extractor.extract(image(), CAMERA)
    metric, descriptors = features.metric, features.descriptors
    assert metric.empty().dtype == descriptors.dtype
    assert metric.empty().shape[1:] == descriptors.shape[1:]
    assert metric.between(descriptors, descriptors).max() <= 1
    apart = metric.between(descriptors[:-1], descriptors[1:])
    assert np.median(apart) > metric.max_distance > metric.strict_distance > 0
    if descriptors.dtype == np.float32:
        np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-4)


def test_larger_keypoints_are_less_certain(extractor: FeatureExtractor) -> None:
    features = extractor.extract(image(), CAMERA)
    np.testing.assert_allclose(features.sigma_px, extractor.levels.sigma_px(features.octave))
    sigma = extractor.levels.sigma_px(np.arange(extractor.levels.count))
    assert (np.diff(sigma) > 0).all()
    assert 0.3 < sigma[0] < 2.0


def test_weak_texture_gets_its_share(extractor: FeatureExtractor) -> None:
    px = extractor.extract(image(), CAMERA).raw_px
    is_strong = (px < [120, 100]).all(axis=1)
    assert 0.05 < np.mean(is_strong) < 0.5


def test_orb_spreads_wider_than_opencv_does(orb: FeatureExtractor) -> None:
    ours = occupancy(orb.extract(image(), CAMERA).raw_px)
    own = cv2.ORB.create(nfeatures=300, fastThreshold=7).detect(image(), None)
    assert ours > 1.3 * occupancy(np.array([k.pt for k in own]))


def test_deterministic(extractor: FeatureExtractor) -> None:
    first = extractor.extract(image(), CAMERA)
    extractor.extract(image(1), CAMERA)  # nothing stays behind of an earlier image
    second = extractor.extract(image(), CAMERA)
    np.testing.assert_array_equal(first.raw_px, second.raw_px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


@pytest.mark.parametrize("grey", [0, 127, 255])
def test_a_blank_image_has_none(extractor: FeatureExtractor, grey: int) -> None:
    features = extractor.extract(np.full((240, 320), grey, np.uint8), CAMERA)
    assert len(features) == 0
    assert features.px.shape == (0, 2)
    assert features.descriptors.shape == features.metric.empty().shape
    assert features.octave.shape == features.sigma_px.shape == (0,)
    assert features.place_descriptors.shape == (0, 32)


@pytest.mark.parametrize("level", range(8))
def test_orb_finds_the_same_places_in_an_image_turned_by_180_degrees(
    orb: FeatureExtractor, level: int
) -> None:
    # OpenCV's own places of a level are off by up to two pixels, the same way in both images
    camera = Camera(640, 480, 500, 500, 319.5, 239.5)
    gray = np.asarray(cv2.resize(image(), (640, 480), interpolation=cv2.INTER_CUBIC), np.uint8)
    upright, turned = (orb.extract(np.ascontiguousarray(one), camera) for one in (gray, gray[::-1, ::-1]))
    a = upright.raw_px[upright.octave == level]
    b = [639, 479] - turned.raw_px[turned.octave == level]
    away = np.linalg.norm(a[:, None] - b, axis=2)
    same = np.flatnonzero(away.min(axis=1) < 0.5 * orb.levels.sigma_px(np.array([level])))
    assert len(same) > 0.5 * len(a) > 0
    np.testing.assert_allclose(np.median(a[same] - b[away[same].argmin(axis=1)], axis=0), 0, atol=0.02)


def test_an_image_too_small_for_a_patch_has_none(orb: FeatureExtractor) -> None:
    camera = Camera(24, 20, 20, 20, 11.5, 9.5)
    gray = np.random.default_rng(0).integers(0, 256, (20, 24), dtype=np.uint8)
    assert len(orb.extract(gray, camera)) == 0


def test_pixels_are_undistorted(extractor: FeatureExtractor) -> None:
    camera = Camera(320, 240, 260, 260, 159.5, 119.5, (0.1, 0.02, 0.001, -0.001, 0.0))
    features = extractor.extract(image(), camera)
    np.testing.assert_allclose(features.px, camera.undistort_points(features.raw_px))
    assert np.abs(features.px - features.raw_px).max() > 1.0
    np.testing.assert_array_equal(features.raw_px, extractor.extract(image(), CAMERA).raw_px)


def test_a_moved_image_is_matched_with_itself(extractor: FeatureExtractor) -> None:
    """By 8 rows and 16 columns: what is at one pixel of the one is there in the other."""
    wide = image(shape=(248, 336))
    a, b = extractor.extract(wide[:240, :320], CAMERA), extractor.extract(wide[8:, 16:], CAMERA)
    i, j = a.match(b, np.arange(len(a)), ratio=0.85)
    assert len(i) > 40
    off = np.linalg.norm(a.px[i] - [16, 8] - b.px[j], axis=1)
    assert np.mean(off < 1.5) > 0.8
    assert np.median(off) < 1.0


def test_places_are_recognised_by_orb(extractor: FeatureExtractor, orb: FeatureExtractor) -> None:
    expected = orb.extract(image(), CAMERA).descriptors
    features = extractor.extract(image(), CAMERA)
    np.testing.assert_array_equal(features.place_descriptors, expected)
    np.testing.assert_array_equal(features.place_descriptors, expected)  # also when the image is gone


def test_a_level_is_the_nearest_size() -> None:
    levels = ScaleLevels(2.0, 3, growth=0.5)
    np.testing.assert_array_equal(
        levels.of(np.array([0.3, 1.0, 1.4, 1.5, 2.0, 4.0, 9.0])), [0, 0, 0, 1, 1, 2, 3]
    )
    np.testing.assert_allclose(levels.sigma_px(np.arange(3)), [1.0, np.sqrt(2.0), 2.0])


def test_matching_keeps_to_the_keypoints_asked_for(orb: FeatureExtractor) -> None:
    features = orb.extract(image(), CAMERA)
    among = np.arange(3, len(features), 7)
    i, j = features.match(features, among, ratio=0.85)
    np.testing.assert_array_equal(among[i], j)
    assert len(i) > 0.9 * len(among)


@pytest.mark.parametrize(
    "wrong", [np.zeros((2, 31), np.uint8), np.zeros((2, 32), np.float32), np.zeros((3, 32), np.uint8)]
)
def test_descriptors_of_another_metric_are_refused(wrong: np.ndarray) -> None:
    px = np.zeros((2, 2))
    with pytest.raises(TrackingError, match=r"2 keypoints need descriptors \(2, 32\) uint8, got"):
        Features(px, px, np.zeros(2, np.int64), np.ones(2), wrong)
    assert len(
        Features(px, px, np.zeros(2, np.int64), np.ones(2), wrong[:2, :31].astype(np.uint8), Hamming(31))
    )
    Features(
        px[:0], px[:0], np.zeros(0, np.int64), np.ones(0), UnitL2(5, 1.0, 0.5).empty(), UnitL2(5, 1.0, 0.5)
    )


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(
        ConfigError, match=r"no feature is called 'surf'; known: akaze, aliked, brisk, orb, sift"
    ):
        create_extractor(FeatureConfig(name="surf"))


def test_what_opencv_lacks_says_which_package_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        for name in ("BRISK", "ALIKED"):
            monkeypatch.delattr(module, name, raising=False)
    with pytest.raises(ConfigError, match=r"'brisk' is not in this OpenCV .*opencv-contrib-python-headless"):
        create_extractor(FeatureConfig(name="brisk"))


def test_weights_files_are_asked_for_where_they_are_needed(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match="'aliked' is a network: name its ONNX file with --features-weights"
    ):
        create_extractor(FeatureConfig(name="aliked"))
    with pytest.raises(ConfigError, match=r"'sift' takes no weights file; leave out some\.onnx"):
        create_extractor(FeatureConfig(name="sift", weights="some.onnx"))
    with pytest.raises(WeightsError, match=r"none\.onnx: no such file with weights of feature 'aliked'"):
        create_extractor(FeatureConfig(name="aliked", weights=str(tmp_path / "none.onnx")))
    assert feature_weights(FeatureConfig()) == ()


def test_two_features_of_one_name_are_refused() -> None:
    feature_names()
    with pytest.raises(ConfigError, match="two features are called 'orb'"):
        register_extractor("orb")(lambda config: create_extractor(config))


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
