# SPDX-License-Identifier: Apache-2.0
"""Which of the directions that lines offer is gravity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from slamdepth.depth.gravity_direction import DownScorer, Look, find_down, token_fields
from slamdepth.depth.upright import roll_rad
from slamdepth.depth.vanishing import ManhattanFrame
from slamdepth.geometry import so3_exp

FRAME = ManhattanFrame(np.eye(3), np.array([0.2, 0.2, 0.2]))
TOKENS = torch.zeros(1, 1, 8, 4, 6)


class Likes(DownScorer):
    """Scores a direction by how far below the horizon the middle of the image then is, times ``much``."""

    def __init__(self, much: float) -> None:
        super().__init__(8, 4)
        self.much, self.looks = much, 0

    def forward(self, tokens: Tensor, fields: Tensor) -> Tensor:
        self.looks += 1
        return self.much * fields[:, :, 0].mean(dim=(2, 3))


def look_at(angles: list[float] | None = None) -> Callable[[float], Look]:
    def look(roll: float) -> Look:
        if angles is not None:
            angles.append(roll)
        return Look(TOKENS, (56, 84), 80.0, roll)

    return look


def test_without_a_liking_the_direction_nearest_to_the_images_vertical_wins() -> None:
    found = find_down(Likes(0.0), [FRAME], look_at())
    assert found is not None
    np.testing.assert_allclose(found.down, [0, 1, 0])


def test_what_the_image_shows_decides() -> None:
    found = find_down(Likes(30.0), [FRAME], look_at())
    assert found is not None
    np.testing.assert_allclose(found.down, [0, 0, 1])
    assert found.share > 0.99


def test_a_frame_more_lines_run_along_wins() -> None:
    tilted = ManhattanFrame(so3_exp(np.array([-0.5, 0.0, 0.0])), np.array([0.3, 0.3, 0.3]))
    found = find_down(Likes(0.0), [FRAME, tilted], look_at())
    assert found is not None
    assert abs(found.down[1]) == pytest.approx(np.cos(0.5))


def test_frames_that_nearly_agree_are_averaged() -> None:
    support = np.array([0.2, 0.2, 0.2])
    leaning = [ManhattanFrame(so3_exp(np.array([0.0, 0.0, angle])), support) for angle in (-0.12, 0.12)]
    found = find_down(Likes(0.0), leaning, look_at())
    assert found is not None
    np.testing.assert_allclose(found.down, [0, 1, 0], atol=1e-6)
    alone = find_down(Likes(0.0), leaning[:1], look_at())
    assert alone is not None
    assert abs(alone.down[0]) == pytest.approx(np.sin(0.12))


def test_lines_that_offer_nothing_tell_nothing() -> None:
    assert find_down(Likes(1.0), [], look_at()) is None


def test_likely_directions_are_looked_at_as_they_say_and_sure_ones_are_not() -> None:
    rolled = ManhattanFrame(so3_exp(np.array([0.0, 0.0, 0.6])), np.array([0.2, 0.2, 0.2]))
    angles: list[float] = []
    found = find_down(Likes(0.0), [rolled], look_at(angles))
    assert found is not None
    assert angles[0] == 0.0
    assert len(angles) == 3
    assert angles[1] == pytest.approx(roll_rad(found.down))
    assert abs(angles[2] - angles[1]) == pytest.approx(np.pi / 2)
    sure: list[float] = []
    find_down(Likes(30.0), [FRAME], look_at(sure))
    assert sure == [0.0]


def test_a_turned_look_sees_directions_turned() -> None:
    look = Look(TOKENS, (56, 84), 80.0, 0.4)
    down = np.array([np.sin(0.4), np.cos(0.4), 0.0])
    np.testing.assert_allclose(look.seen(down), [0, 1, 0], atol=1e-12)


def test_scores_depend_on_the_direction_and_have_its_shape() -> None:
    torch.manual_seed(0)
    scorer = DownScorer(16, 8).eval()
    tokens = torch.randn(2, 2, 8, 4, 6)
    directions = torch.eye(3)
    fields = token_fields(directions, 80.0, 56, 84)
    assert fields.shape == (3, 4, 4, 6)
    scores = scorer(tokens, fields.expand(2, 3, 4, 4, 6))
    assert scores.shape == (2, 3)
    assert scores[0].unique().numel() == 3
