# SPDX-License-Identifier: Apache-2.0
"""Mixed training views: exact composition of two scenes, and reproducibility."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from training_places import make_place

from slamdepth.training.augment import View, mixed_view
from slamdepth.training.config import AugmentConfig, ViewConfig
from slamdepth.training.data import open_place
from slamdepth.training.views import Partner, SampleKey, make_view

RED, BLUE = (200, 0, 0), (0, 0, 200)
DEPTHS = arrays(np.float32, (6, 9), elements=st.sampled_from([0.0, 0.5, 1.0, 2.0, 4.0]))


def wall(colour: tuple[int, int, int], depth_m: np.ndarray, focal_px: float) -> View:
    image = np.empty((*depth_m.shape, 3), np.uint8)
    image[:] = colour
    return View(image, depth_m.astype(np.float32), focal_px)


def test_the_nearer_surface_hides_the_farther_one() -> None:
    near_left = np.full((6, 9), 3.0)
    near_left[:, :4] = 1.0
    mixed = mixed_view(wall(RED, near_left, 100.0), wall(BLUE, np.full((6, 9), 2.0), 100.0))
    assert (mixed.image_rgb[:, :4] == RED).all()
    assert (mixed.image_rgb[:, 4:] == BLUE).all()
    np.testing.assert_array_equal(mixed.depth_m, np.where(near_left == 1.0, 1.0, 2.0))
    assert mixed.focal_px == 100.0


def test_depth_is_normalised_to_the_focal_length_of_the_first() -> None:
    # 2 m at 200 px look like 1 m at 100 px, which is nearer than 1.5 m.
    mixed = mixed_view(wall(RED, np.full((6, 9), 1.5), 100.0), wall(BLUE, np.full((6, 9), 2.0), 200.0))
    assert (mixed.image_rgb == BLUE).all()
    np.testing.assert_allclose(mixed.depth_m, 1.0)


def test_unknown_depth_takes_its_nearest_known_depth_and_stays_unknown() -> None:
    holed = np.full((6, 9), 1.0)
    holed[2:4, 3:6] = 0.0
    mixed = mixed_view(wall(RED, holed, 100.0), wall(BLUE, np.full((6, 9), 2.0), 100.0))
    assert (mixed.image_rgb == RED).all()
    np.testing.assert_array_equal(mixed.depth_m, holed)


@given(DEPTHS, DEPTHS)
def test_every_pixel_has_colour_and_depth_of_one_of_the_two(
    first_m: np.ndarray, second_m: np.ndarray
) -> None:
    mixed = mixed_view(wall(RED, first_m, 100.0), wall(BLUE, second_m, 100.0))
    is_first = (mixed.image_rgb == RED).all(axis=2)
    assert (is_first | (mixed.image_rgb == BLUE).all(axis=2)).all()
    np.testing.assert_array_equal(mixed.depth_m, np.where(is_first, first_m, second_m))
    both = (first_m > 0) & (second_m > 0)
    np.testing.assert_array_equal(mixed.depth_m[both], np.minimum(first_m, second_m)[both])


def test_mixed_views_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    places = [open_place(make_place(tmp_path / name)) for name in ("hall", "loft")]
    config = ViewConfig(rows=56, columns=70, augment=AugmentConfig(mixed=1.0, mixed_again=1.0))
    key = SampleKey(0, 1, 2)
    partners = [Partner(place, config.augment, weight) for place, weight in zip(places, (1, 3), strict=True)]
    once, again = (make_view(places, key, config, 3, partners) for _ in range(2))
    np.testing.assert_array_equal(once.image_rgb, again.image_rgb)
    np.testing.assert_array_equal(once.depth_m, again.depth_m)
    alone = make_view(places, key, ViewConfig(rows=56, columns=70), 3, partners)
    assert (alone.image_rgb != once.image_rgb).any()
