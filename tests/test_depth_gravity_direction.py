# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity: which of the directions that lines propose is chosen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from slamdepth.depth.gravity_direction import EncodedImage, GravityScorer, estimate_gravity, token_fields
from slamdepth.depth.upright import roll_rad
from slamdepth.depth.vanishing import ManhattanFrame
from slamdepth.geometry import so3_exp

FRAME = ManhattanFrame(np.eye(3), np.array([0.2, 0.2, 0.2]))
TOKENS = torch.zeros(1, 1, 8, 4, 6)


class PrefersSteep(GravityScorer):
    """Scores a direction by how far below the horizon the middle of the image then is, times ``weight``."""

    def __init__(self, weight: float) -> None:
        super().__init__(8, 4)
        self.weight = weight

    def forward(self, tokens: Tensor, fields: Tensor) -> Tensor:
        return self.weight * fields[:, :, 0].mean(dim=(2, 3))


def encoder(rolls: list[float] | None = None) -> Callable[[float], EncodedImage]:
    """Encodes an image; the rolls asked for are appended to ``rolls``."""

    def encode(roll: float) -> EncodedImage:
        if rolls is not None:
            rolls.append(roll)
        return EncodedImage(TOKENS, (56, 84), 80.0, roll)

    return encode


def test_where_scores_are_equal_the_direction_nearest_to_the_images_vertical_is_chosen() -> None:
    found = estimate_gravity(PrefersSteep(0.0), [FRAME], encoder())
    assert found is not None
    np.testing.assert_allclose(found.gravity, [0, 1, 0])


def test_the_score_of_the_image_outweighs_the_prior() -> None:
    found = estimate_gravity(PrefersSteep(30.0), [FRAME], encoder())
    assert found is not None
    np.testing.assert_allclose(found.gravity, [0, 0, 1])
    assert found.share > 0.99


def test_the_frame_with_more_support_is_chosen() -> None:
    tilted = ManhattanFrame(so3_exp(np.array([-0.5, 0.0, 0.0])), np.array([0.3, 0.3, 0.3]))
    found = estimate_gravity(PrefersSteep(0.0), [FRAME, tilted], encoder())
    assert found is not None
    assert abs(found.gravity[1]) == pytest.approx(np.cos(0.5))


def test_directions_that_nearly_agree_are_averaged() -> None:
    support = np.array([0.2, 0.2, 0.2])
    leaning = [ManhattanFrame(so3_exp(np.array([0.0, 0.0, angle])), support) for angle in (-0.12, 0.12)]
    found = estimate_gravity(PrefersSteep(0.0), leaning, encoder())
    assert found is not None
    np.testing.assert_allclose(found.gravity, [0, 1, 0], atol=1e-6)
    alone = estimate_gravity(PrefersSteep(0.0), leaning[:1], encoder())
    assert alone is not None
    assert abs(alone.gravity[0]) == pytest.approx(np.sin(0.12))


def test_without_manhattan_frames_there_is_no_estimate() -> None:
    assert estimate_gravity(PrefersSteep(1.0), [], encoder()) is None


def test_the_image_is_scored_again_rotated_by_each_probable_direction_if_there_are_two() -> None:
    rolled = ManhattanFrame(so3_exp(np.array([0.0, 0.0, 0.6])), np.array([0.2, 0.2, 0.2]))
    rolls: list[float] = []
    found = estimate_gravity(PrefersSteep(0.0), [rolled], encoder(rolls))
    assert found is not None
    assert rolls[0] == 0.0
    assert len(rolls) == 3
    assert rolls[1] == pytest.approx(roll_rad(found.gravity))
    assert abs(rolls[2] - rolls[1]) == pytest.approx(np.pi / 2)
    certain: list[float] = []
    estimate_gravity(PrefersSteep(30.0), [FRAME], encoder(certain))
    assert certain == [0.0]


def share_of(size: tuple[int, int], *, is_same: bool = False) -> float:
    """Share of the best direction where three looks are asked for, or always the same one is given."""
    rolled = ManhattanFrame(so3_exp(np.array([0.0, 0.0, 0.6])), np.array([0.2, 0.2, 0.2]))
    first = EncodedImage(TOKENS, size, 80.0, 0.0)

    def encode(roll: float) -> EncodedImage:
        return first if is_same or roll == 0.0 else EncodedImage(TOKENS, size, 80.0, roll)

    found = estimate_gravity(PrefersSteep(3.0), [rolled], encode)
    assert found is not None
    return found.share


def test_looks_at_a_portrait_image_are_averaged_and_count_once() -> None:
    one, three = share_of((84, 56), is_same=True), share_of((84, 56))
    assert three == pytest.approx(one, abs=0.02)
    assert share_of((56, 84)) > three + 0.02  # added in a landscape image


def test_directions_are_rotated_with_the_image() -> None:
    image = EncodedImage(TOKENS, (56, 84), 80.0, 0.4)
    gravity = np.array([np.sin(0.4), np.cos(0.4), 0.0])
    np.testing.assert_allclose(image.rotated(gravity), [0, 1, 0], atol=1e-12)


def test_scores_depend_on_the_direction_and_have_its_shape() -> None:
    torch.manual_seed(0)
    scorer = GravityScorer(16, 8).eval()
    tokens = torch.randn(2, 2, 8, 4, 6)
    directions = torch.eye(3)
    fields = token_fields(directions, 80.0, 56, 84)
    assert fields.shape == (3, 4, 4, 6)
    scores = scorer(tokens, fields.expand(2, 3, 4, 4, 6))
    assert scores.shape == (2, 3)
    assert scores[0].unique().numel() == 3
