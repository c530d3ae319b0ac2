# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity in one image: straight lines propose directions, a small network scores them.

Straight lines give directions in space to a few degrees, but neither which of them is vertical nor its
sense. Semantics does: floors are below, ceilings above, desks are seen from above. Each direction that the
lines propose (:mod:`slamdepth.depth.vanishing`) is turned into a gravity field, which says how far below the
horizon each token would be if it were gravity; the network scores how well field and tokens agree. The prior
is a camera held roughly upright.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.gravity_field import gravity_field
from slamdepth.depth.head_layers import GRAVITY_CHANNELS
from slamdepth.depth.upright import roll_rad
from slamdepth.depth.vanishing import ManhattanFrame
from slamdepth.geometry import so3_exp
from slamdepth.typing import Floats

FRAMES = 12
"""Number of Manhattan frames whose axes are proposed."""
_SUPPORT_WEIGHT = 30.0  # log odds per share of the lines that run along a frame
_PRIOR_GRAVITY = np.array([0.0, np.cos(np.radians(20.0)), np.sin(np.radians(20.0))])
"""Gravity in a camera that is held upright and looks a little down."""
_PRIOR_ANGLE_RAD = np.radians(45.0)  # by so much farther from the prior is e times less likely
_COS_SAME = np.cos(np.radians(20.0))
_COS_ALIKE = np.cos(np.radians(25.0))
_ROTATIONS = 2
_MIN_PROBABILITY = 0.01


@dataclass(frozen=True)
class GravityEstimate:
    """Direction of gravity in an image.

    Attributes:
        gravity: ``(3,)`` unit vector in the camera's frame (x right, y down, z forward).
        share: probability of the directions it is the mean of, 0 to 1.
    """

    gravity: Floats
    share: float


class GravityScorer(nn.Module):
    """Scores candidate directions of gravity given the tokens of an image.

    Args:
        width: channels of all tapped blocks together.
        dim: channels of the hidden layers.
        dropout: share of token channels dropped; works in training only.
    """

    def __init__(self, width: int, dim: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.drop = nn.Dropout2d(dropout)
        self.tokens = nn.Conv2d(width, dim, 1)
        self.context = nn.Conv2d(dim, dim, 3, padding=1)
        self.field = nn.Conv2d(GRAVITY_CHANNELS, dim, 1)
        self.joint = nn.Conv2d(dim, dim, 3, padding=1)
        self.out = nn.Linear(dim, 1)

    def forward(self, tokens: Tensor, fields: Tensor) -> Tensor:
        """Scores ``(B, C)`` of ``C`` candidate directions for each image.

        Args:
            tokens: ``(B, taps, dim, h, w)``.
            fields: ``(B, C, 4, h, w)``, the gravity field of each candidate, one value per token; see
                :func:`token_fields`.
        """
        image = F.gelu(self.tokens(self.drop(tokens.flatten(1, 2))))
        image = image + F.gelu(self.context(image))
        field = self.field(fields.flatten(0, 1)).unflatten(0, fields.shape[:2])
        both = F.gelu(image[:, None] * field).flatten(0, 1)
        both = F.gelu(both + self.joint(both))
        scores: Tensor = self.out(both.mean(dim=(2, 3)))
        return scores.reshape(fields.shape[:2])


@dataclass(frozen=True)
class EncodedImage:
    """The backbone's tokens of an image that may have been rotated about its principal point.

    Attributes:
        tokens: ``(1, taps, dim, h, w)``.
        size: rows and columns of the network's input.
        focal_px: focal length in pixels of the network's input.
        roll_rad: roll of the camera that the rotation undid, see :func:`~slamdepth.depth.upright.roll_rad`; 0
            for the image as taken.
    """

    tokens: Tensor
    size: tuple[int, int]
    focal_px: float
    roll_rad: float = 0.0

    def rotated(self, directions: Floats) -> Floats:
        """Directions ``(..., 3)`` of the camera that took the image, in the frame of the rotated image."""
        rotated: Floats = directions @ so3_exp(np.array([0.0, 0.0, self.roll_rad])).T
        return rotated


def token_fields(directions: Tensor, focal_px: float, rows: int, columns: int) -> Tensor:
    """Gravity fields with one value per token.

    Args:
        directions: ``(C, 3)`` unit vectors in the camera's frame.
        focal_px: focal length in pixels of the network's input.
        rows, columns: of the network's input.

    Returns:
        ``(C, 4, rows / 14, columns / 14)``; for the channels see
        :func:`~slamdepth.depth.gravity_field.gravity_field`.
    """
    focal = torch.full((len(directions),), focal_px, device=directions.device)
    return F.avg_pool2d(gravity_field(directions, focal, rows, columns), 2)


def estimate_gravity(
    scorer: GravityScorer,
    frames: Sequence[ManhattanFrame],
    encode: Callable[[float], EncodedImage],
    guess_rad: float | None = None,
) -> GravityEstimate | None:
    """The most probable direction of gravity in an image; None where lines propose none.

    Lines propose several directions that differ by a few degrees. The estimate is the mean, weighted by
    probability, of the directions within 20 degrees of one another that together are most probable.

    The scorer sees the image as taken. Where more than one direction is probable, it also sees the image
    rotated upright by each of the two most probable ones, because upright images are recognised better.
    In a portrait image these looks are averaged, see :func:`_added_by_more_looks`. With a guess of the roll
    it sees the image rotated upright by that, and no other.

    Args:
        scorer: scores directions given the tokens.
        frames: the Manhattan frames whose axes are proposed.
        encode: the image rotated upright from a roll in radians, or from about that roll; the same object
            where it was asked for before.
        guess_rad: roll in radians that is expected; None where nothing is known.
    """
    if not frames:
        return None
    candidates = np.concatenate([np.concatenate([frame.axes, -frame.axes]) for frame in frames])
    support = np.repeat([frame.support.sum() for frame in frames], 6)
    prior_angle = np.arccos(np.clip(candidates @ _PRIOR_GRAVITY, -1.0, 1.0))
    looks = [encode(guess_rad or 0.0)]
    log_likelihoods = [_log_likelihood(scorer, looks[0], candidates)]
    log_probability = log_likelihoods[0] + _SUPPORT_WEIGHT * support - prior_angle / _PRIOR_ANGLE_RAD
    if guess_rad is None:
        modes = _modes(candidates, _normalised(log_probability))
        for mode in modes if len(modes) > 1 else ():
            looks.append(encode(roll_rad(mode)))
            log_likelihoods.append(_log_likelihood(scorer, looks[-1], candidates))
        for added in _added_by_more_looks(looks, log_likelihoods):
            log_probability = log_probability + added
    probability = _normalised(log_probability)
    is_near = candidates @ candidates.T > _COS_SAME
    best = is_near[int((is_near @ probability).argmax())]
    gravity = probability[best] @ candidates[best]
    return GravityEstimate(gravity / np.linalg.norm(gravity), float(probability[best].sum()))


def _added_by_more_looks(looks: Sequence[EncodedImage], log_likelihoods: Sequence[Floats]) -> list[Floats]:
    """What all looks at an image add to the log likelihood ``(C,)`` of the candidates given the first one.

    The looks show one scene and err together, the more so in portrait images, which the scorer was not
    trained on. Where the first look, which is the image as taken, is portrait, each look counts once, and
    the log likelihoods are averaged. Else they are added.
    """
    rows, columns = looks[0].size
    if rows <= columns:
        return list(log_likelihoods[1:])
    once = {id(look): each for look, each in zip(looks, log_likelihoods, strict=True)}
    return [np.mean(list(once.values()), axis=0) - log_likelihoods[0]]


def _log_likelihood(scorer: GravityScorer, image: EncodedImage, candidates: Floats) -> Floats:
    """Log probability ``(C,)`` of each candidate given the tokens alone."""
    directions = torch.from_numpy(image.rotated(candidates)).float().to(image.tokens.device)
    with torch.inference_mode():
        scores = scorer(image.tokens, token_fields(directions, image.focal_px, *image.size)[None])
        return torch.log_softmax(scores[0], dim=0).cpu().numpy().astype(np.float64)


def _normalised(log_probability: Floats) -> Floats:
    probability = np.exp(log_probability - log_probability.max())
    return np.asarray(probability / probability.sum())


def _modes(candidates: Floats, probability: Floats) -> list[Floats]:
    """At most two most probable directions, at least 25 degrees from one another."""
    left, out = probability.copy(), []
    for _ in range(_ROTATIONS):
        best = int(left.argmax())
        is_alike = candidates @ candidates[best] > _COS_ALIKE
        if left[is_alike].sum() < _MIN_PROBABILITY:
            break
        out.append(candidates[best])
        left[is_alike] = 0.0
    return out
