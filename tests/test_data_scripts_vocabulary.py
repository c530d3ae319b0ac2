# SPDX-License-Identifier: Apache-2.0
"""Training of the ORB vocabulary."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_places import random_descriptors, with_flipped_bits

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"
sys.path.insert(0, str(SCRIPTS))

from train_vocabulary import k_majority, main, train_vocabulary  # noqa: E402

from slamdepth.loops.vocabulary import load_vocabulary  # noqa: E402


def test_k_majority_finds_the_centres_of_well_separated_clusters() -> None:
    rng = np.random.default_rng(1)
    centres = random_descriptors(rng, 6)
    members = np.repeat(np.arange(6), 41)
    found, cluster = k_majority(with_flipped_bits(centres[members], 20, rng), 6, rng)
    assert {bytes(c) for c in found} == {bytes(c) for c in centres}
    assert len({(a, b) for a, b in zip(members, cluster, strict=True)}) == 6


def test_k_majority_needs_enough_distinct_descriptors() -> None:
    with pytest.raises(ValueError, match="3 clusters need as many distinct descriptors, got 2"):
        k_majority(
            np.repeat(random_descriptors(np.random.default_rng(0), 2), 5, axis=0), 3, np.random.default_rng(0)
        )


def test_training_is_deterministic_and_weighs_by_images() -> None:
    rng = np.random.default_rng(2)
    images = [random_descriptors(rng, 60) for _ in range(8)]
    first, second = (train_vocabulary(images, 4, 5, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.words, second.words)
    seen = [sum(w in first.quantise(image) for image in images) for w in range(20)]
    np.testing.assert_allclose(first.idf, np.log(8 / np.maximum(seen, 1)), atol=1e-6)


def test_the_training_command_writes_a_vocabulary(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for place in ("hall", "kitchen_kinect"):
        (tmp_path / place).mkdir()
        for k in range(2):
            blobs = cv2.resize(rng.integers(0, 256, (30, 40), dtype=np.uint8), (320, 240))
            cv2.imwrite(str(tmp_path / place / f"{k}.jpg"), blobs)
    command = ["--data", str(tmp_path), "--branches", "3", "--leaves", "4"]
    assert main([*command, "--output", str(tmp_path / "v.npz")]) == 0
    vocabulary = load_vocabulary(tmp_path / "v.npz")
    assert len(vocabulary) == 12
    assert "of 2 images" in vocabulary.description  # the left-out place does not count


def test_bad_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    for data, name, says in (
        ("empty", "v.txt", "must be a .npz file"),
        ("absent", "v.npz", "no such folder"),
        ("empty", "v.npz", "no image found"),
    ):
        assert main(["--data", str(tmp_path / data), "--output", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert says in error
        assert error.count("\n") == 1
