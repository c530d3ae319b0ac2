# SPDX-License-Identifier: Apache-2.0
"""Binary words and place recognition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequences import imread

from slamdepth.errors import TrackingError, WeightsError
from slamdepth.frontend.metric import hamming_nearest
from slamdepth.geometry import quat_xyzw_to_rotation, rotation_angle_rad
from slamdepth.loops.places import PlaceRecogniser
from slamdepth.loops.vocabulary import Vocabulary, load_vocabulary


def random_descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def with_flipped_bits(descriptors: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    unpacked = np.unpackbits(descriptors, axis=1)
    for row in unpacked:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(unpacked, axis=1)


@pytest.fixture(scope="module")
def tiny() -> Vocabulary:
    return Vocabulary(random_descriptors(np.random.default_rng(5), 50), np.ones(50, dtype=np.float32))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_nearest_is_the_nearest_in_hamming_distance(count: int, centres: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_descriptors(rng, count), random_descriptors(rng, centres)
    b[-1] = b[0]  # a tie goes to the first
    bits = np.unpackbits(a, axis=1)[:, None] != np.unpackbits(b, axis=1)[None]
    np.testing.assert_array_equal(hamming_nearest(a, b), bits.sum(axis=2).argmin(axis=1))


def test_all_256_bits_different_is_far_and_not_near() -> None:
    zeros, ones = np.zeros((1, 32), dtype=np.uint8), np.full((1, 32), 255, dtype=np.uint8)
    assert (
        hamming_nearest(
            zeros, np.concatenate([ones, with_flipped_bits(zeros, 200, np.random.default_rng(0))])
        )
        == 1
    )


@pytest.mark.parametrize(
    "wrong", [np.zeros((3, 31), np.uint8), np.zeros((3, 32), np.float32), np.zeros(32, np.uint8)]
)
def test_other_descriptors_are_refused(tiny: Vocabulary, wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"\(N, 32\) uint8"):
        tiny.quantise(wrong)


def test_a_vocabulary_survives_the_disk_byte_for_byte(tmp_path: Path, tiny: Vocabulary) -> None:
    tiny.save(tmp_path / "a.npz")
    tiny.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    np.testing.assert_array_equal(load_vocabulary(tmp_path / "a.npz").words, tiny.words)


def test_a_damaged_vocabulary_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "v.npz"
    with pytest.raises(WeightsError, match="cannot read the vocabulary"):
        load_vocabulary(path)
    path.write_bytes(b"not a zip file")
    with pytest.raises(WeightsError, match=r"v\.npz: cannot read"):
        load_vocabulary(path)
    np.savez(path, words=np.zeros((3, 7), np.uint8), idf=np.ones(3, np.float32), description="")
    with pytest.raises(WeightsError, match=r"v\.npz: vocabulary: words must be"):
        load_vocabulary(path)


def test_the_shipped_vocabulary_is_whole() -> None:
    shipped = load_vocabulary()
    assert len(shipped) == 2000
    assert len(np.unique(shipped.words, axis=0)) == 2000
    assert "depth_training" in shipped.description
    np.testing.assert_array_equal(shipped.quantise(shipped.words), np.arange(2000))


def test_the_same_place_comes_first_under_noise() -> None:
    rng = np.random.default_rng(7)
    places = [random_descriptors(rng, 200) for _ in range(20)]
    recogniser = PlaceRecogniser()
    for k, place in enumerate(places):
        recogniser.add(10 * k, place)
    for k, place in enumerate(places):
        seen_again = np.concatenate([with_flipped_bits(place[60:], 5, rng), random_descriptors(rng, 60)])
        answers = recogniser.query(seen_again, top_k=3)
        assert answers[0][0] == 10 * k
        assert answers[0][1] > 1.5 * answers[1][1]


def test_scores_are_cosines_and_ties_are_ordered_by_id(tiny: Vocabulary) -> None:
    recogniser = PlaceRecogniser(tiny)
    for k in (7, 3, 5):
        recogniser.add(k, tiny.words[:4])
    recogniser.add(1, tiny.words[2:6])
    recogniser.add(2, tiny.words[10:14])
    answers = recogniser.query(tiny.words[:4])
    assert answers == [(3, 1.0), (5, 1.0), (7, 1.0), (1, 0.5)]  # keyframe 2 shares no word
    assert recogniser.query(tiny.words[:4], exclude={3, 7, 99}, top_k=1) == [(5, 1.0)]
    assert recogniser.query_keyframe(5) == [(3, 1.0), (7, 1.0), (1, 0.5)]
    assert recogniser.score(7, 1) == 0.5


def test_repeated_words_count_by_their_root(tiny: Vocabulary) -> None:
    recogniser = PlaceRecogniser(tiny)
    vector = recogniser.describe(tiny.words[[0, 0, 0, 0, 1]])
    np.testing.assert_allclose(vector[:2], np.array([2.0, 1.0]) / np.sqrt(5), atol=1e-6)


def test_the_index_grows_past_its_first_size(tiny: Vocabulary) -> None:
    recogniser = PlaceRecogniser(tiny)
    for k in range(150):
        recogniser.add(k, tiny.words[[k % 50]])
    assert len(recogniser) == 150
    assert 149 in recogniser
    assert [i for i, _ in recogniser.query(tiny.words[[3]])] == [3, 53, 103]


def test_no_descriptors_match_nothing(tiny: Vocabulary) -> None:
    recogniser = PlaceRecogniser(tiny)
    nothing = np.empty((0, 32), dtype=np.uint8)
    assert recogniser.query(nothing) == []
    recogniser.add(0, nothing)
    recogniser.add(1, tiny.words)
    assert recogniser.query(nothing) == []
    assert recogniser.query(tiny.words, top_k=0) == []


def test_misuse_is_refused(tiny: Vocabulary) -> None:
    recogniser = PlaceRecogniser(tiny)
    recogniser.add(4, tiny.words)
    with pytest.raises(TrackingError, match="keyframe 4 was added before"):
        recogniser.add(4, tiny.words)
    with pytest.raises(TrackingError, match="keyframe 5 was never added"):
        recogniser.query_keyframe(5)


@pytest.mark.data
def test_a_real_loop_is_among_the_first_ten(data_dir: Path) -> None:
    """fr1_desk comes back to where it began; a loop is within 0.35 m, 30 degrees, 100 frames apart."""
    import cv2

    folder = data_dir / "rgbd_dataset_freiburg1_desk"
    truth = np.loadtxt(folder / "groundtruth.txt")
    lines = [line.split() for line in (folder / "rgb.txt").read_text().splitlines() if line[:1] != "#"][::10]
    rows = [int(np.argmin(np.abs(truth[:, 0] - float(stamp)))) for stamp, _ in lines]
    position_m, R = truth[rows, 1:4], quat_xyzw_to_rotation(truth[rows, 4:8])
    apart = 10 * np.abs(np.subtract.outer(np.arange(len(rows)), np.arange(len(rows)))) >= 100
    near = np.linalg.norm(position_m[:, None] - position_m[None], axis=2) < 0.35
    turned = rotation_angle_rad(np.einsum("iab,jac->ijbc", R, R))
    is_loop = apart & near & (turned < np.radians(30))

    orb = cv2.ORB.create(nfeatures=1000, fastThreshold=7)
    recogniser = PlaceRecogniser()
    for k, (_, name) in enumerate(lines):
        image = imread(folder / name, cv2.IMREAD_GRAYSCALE)
        recogniser.add(k, np.asarray(orb.detectAndCompute(image, None)[1], np.uint8))
    queries = np.flatnonzero(is_loop.any(axis=1)).tolist()
    found = [
        any(
            is_loop[k, i] for i, _ in recogniser.query_keyframe(k, exclude=np.flatnonzero(~apart[k]).tolist())
        )
        for k in queries
    ]
    assert len(queries) > 30
    assert np.mean(found) > 0.8
