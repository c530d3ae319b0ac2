# SPDX-License-Identifier: Apache-2.0
"""Iterating over the frames of a dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up import MadeUpDataset
from sequences import make_tum

from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import CameraError


def test_a_dataset_is_iterated_in_order_with_its_depth(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path / "tum"))
    frames = list(dataset)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for frame in frames:
        expected = dataset.read(frame.index, with_depth=True)
        np.testing.assert_array_equal(frame.image_rgb, expected.image_rgb)
        np.testing.assert_array_equal(frame.depth_m, expected.depth_m)
    assert [frame.index for frame in dataset] == [0, 1, 2, 3]  # a second time from the start


def test_frames_have_no_depth_unless_asked_for(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path / "tum"))
    assert all(frame.depth_m is None for frame in dataset.frames())
    assert all(frame.depth_m is not None for frame in dataset.frames(with_depth=True))
    (tmp_path / "tum" / "depth.txt").unlink()
    assert all(frame.depth_m is None for frame in open_dataset(tmp_path / "tum"))


def test_images_that_do_not_decode_are_skipped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    dataset: Dataset = MadeUpDataset(6, broken=(1, 4), broken_depth=(3,))
    frames = {frame.index: frame for frame in dataset}
    assert list(frames) == [0, 2, 3, 5]
    assert [index for index, frame in frames.items() if frame.depth_m is None] == [3]
    assert [record.message.partition(":")[0] for record in caplog.records] == [
        "image skipped",
        "depth of frame 3 left out",
        "image skipped",
    ]


def test_an_image_of_another_size_ends_the_iteration() -> None:
    dataset = MadeUpDataset(3)
    dataset.wrong_size = 1
    frames = iter(dataset)
    next(frames)
    with pytest.raises(CameraError, match="the camera says 8x6"):
        next(frames)
