# SPDX-License-Identifier: Apache-2.0
"""Patches found again in another image, to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slamdepth.frontend.patch_alignment import ImagePyramid, Templates, align, align_near, central_views
from slamdepth.typing import Bytes, Floats

POINTS = np.array([[60.0, 50.0], [100.0, 70.0], [80.0, 90.0], [130.0, 60.0]])
ONES = np.ones(len(POINTS))
SAME = np.broadcast_to(np.eye(2), (len(POINTS), 2, 2))


def texture(px: Floats) -> Floats:
    """A smooth pattern in grey values at pixels ``(..., 2)``."""
    rng = np.random.default_rng(3)
    value = np.full(px.shape[:-1], 120.0)
    for _ in range(40):
        value += 8 * np.sin(px @ rng.uniform(-0.5, 0.5, 2) + rng.uniform(0, 6.3))
    return value


def image(
    warp: Floats | None = None, shift: tuple[float, float] = (0, 0), gain: float = 1, bias: float = 0
) -> Bytes:
    """The pattern, its offsets from the image's middle warped and shifted: ``out = warp @ in + shift``."""
    inverse = np.linalg.inv(np.eye(2) if warp is None else warp)
    v, u = np.mgrid[:140, :200].astype(np.float64)
    at = np.stack([u, v], axis=-1) - [100, 70] - np.array(shift)
    grey = np.clip(np.rint(gain * texture(at @ inverse.T + [100, 70]) + bias), 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def found(other: Bytes, warp: Floats, start: Floats, spacing: float = 1.0) -> tuple[Floats, Floats]:
    templates = Templates.of(ImagePyramid(image()), POINTS, spacing * ONES)
    assert templates.is_usable.all()
    return align(ImagePyramid(other), templates, np.broadcast_to(warp, (len(POINTS), 2, 2)), start)


@pytest.mark.parametrize("spacing", [1.0, 1.6, 2.5])
@pytest.mark.parametrize("shift", [(0.3, -0.4), (-0.75, 0.1), (1.2, 0.9)])
def test_a_shift_is_found_to_a_few_hundredths(shift: tuple[float, float], spacing: float) -> None:
    px, correlation = found(image(shift=shift), np.eye(2), POINTS, spacing)
    np.testing.assert_allclose(px, POINTS + shift, atol=0.05 * max(1.0, spacing / 1.6))
    assert (correlation > 0.99).all()


def test_brightness_and_contrast_do_not_matter() -> None:
    px, correlation = found(image(shift=(0.5, 0.25), gain=0.6, bias=40), np.eye(2), POINTS)
    np.testing.assert_allclose(px, POINTS + np.array([0.5, 0.25]), atol=0.04)
    assert (correlation > 0.99).all()


@pytest.mark.parametrize("degrees", [-30, 12])
@pytest.mark.parametrize("zoom", [0.8, 1.0, 1.3])
def test_a_warped_view_is_found_where_the_warp_is_known(degrees: float, zoom: float) -> None:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    warp = zoom * np.array([[c, -s], [s, c]])
    truth = (POINTS - [100, 70]) @ warp.T + [100, 70]
    px, correlation = found(image(warp), warp, truth + np.array([0.6, -0.5]))
    np.testing.assert_allclose(px, truth, atol=0.1)
    assert (correlation > 0.98).all()


def test_another_place_does_not_correlate() -> None:
    _, correlation = found(image(), np.eye(2), POINTS + np.array([25.0, 17.0]))
    assert (correlation < 0.85).any()


def test_an_edge_and_a_blank_wall_tell_no_place() -> None:
    grey = np.full((140, 200, 3), 80, np.uint8)
    grey[:, 60:] = 180  # an edge through the first point
    assert not Templates.of(ImagePyramid(grey), POINTS, ONES).is_usable.any()


def test_patches_beyond_the_border_do_no_harm() -> None:
    corner = np.array([[0.0, 0.0], [199.0, 139.0], [-3.0, 70.0], [100.0, 141.0]])
    templates = Templates.of(ImagePyramid(image()), corner, ONES)
    px, correlation = align(ImagePyramid(image(shift=(0.3, 0.1))), templates, SAME, corner)
    assert np.isfinite(px).all()
    assert np.isfinite(correlation).all()


def test_no_patches_at_all() -> None:
    nothing = Templates.of(ImagePyramid(image()), np.zeros((0, 2)), np.zeros(0))
    px, correlation = align(ImagePyramid(image()), nothing, np.zeros((0, 2, 2)), np.zeros((0, 2)))
    assert px.shape == (0, 2)
    assert correlation.shape == (0,)


def test_the_same_patches_one_by_one_or_together() -> None:
    pyramid, other = ImagePyramid(image()), ImagePyramid(image(shift=(0.3, -0.4)))
    together = Templates.of(pyramid, POINTS, ONES)
    parts = [Templates.of(pyramid, POINTS[n : n + 1], ONES[:1]) for n in range(len(POINTS))]
    joined = Templates.joined(parts)
    np.testing.assert_allclose(joined.values, together.values, atol=1e-5)
    assert len(joined.taken(np.array([2, 0])).values) == 2
    np.testing.assert_allclose(
        align(other, joined, SAME, POINTS)[0], align(other, together, SAME, POINTS)[0], atol=1e-3
    )


def test_a_patch_is_believed_near_where_it_was_expected_and_at_about_its_size() -> None:
    templates, start = Templates.of(ImagePyramid(image()), POINTS, ONES), POINTS + 1.0
    there = ImagePyramid(image())
    px, good = align_near(there, templates, SAME, start, np.array([2.0, 2.0, 1.0, 1.0]))
    np.testing.assert_allclose(px, POINTS, atol=0.02)
    assert good.tolist() == [True, True, False, False]  # 1.4 px away
    assert not align_near(there, templates, 2.1 * SAME, POINTS, 2.0)[1].any()


def test_the_view_in_the_middle_of_all_is_taken_for_each_point() -> None:
    towards = np.array([[1.0, 0, 1], [0, 2, 2], [0, 0, 5], [-1, 0, 1]])
    point = np.array([0, 2, 0, 0])
    assert central_views(towards, point, 4).tolist() == [2, -1, 1, -1]
