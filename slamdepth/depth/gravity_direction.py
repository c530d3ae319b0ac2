# SPDX-License-Identifier: Apache-2.0
"""Which way is down in one image: lines offer directions, a small network says which of them it is.

Straight lines tell directions in space to a few degrees, but not which of them is vertical, nor its
sense. What is seen does: floors are below, ceilings above, desks are seen from above. So each direction
that lines offer (:mod:`slamdepth.depth.vanishing`) is shown to a network beside the backbone's tokens, as
the field of how far below the horizon every token would be if it were down; the network scores how well
the two go together. A camera that is held upright is more likely than one that is not.
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
"""Manhattan frames whose axes are offered."""
_SUPPORT_WEIGHT = 30.0  # log odds per share of the lines that run along a frame
_USUAL = np.array([0.0, np.cos(np.radians(20.0)), np.sin(np.radians(20.0))])
"""Gravity in a camera that is held upright and looks a little down."""
_AWAY_RAD = np.radians(45.0)  # a direction as much farther from it is e times as unlikely
_SAME = np.cos(np.radians(20.0))
_ALIKE = np.cos(np.radians(25.0))
_LOOKED_AT = 2
_NOT_LIKELY = 0.01


@dataclass(frozen=True)
class DownEstimate:
    """Direction of gravity in an image.

    Attributes:
        down: ``(3,)``, unit, in the camera's frame (x right, y down, z forward).
        share: how much of the belief it is the mean of, 0 to 1.
    """

    down: Floats
    share: float


class DownScorer(nn.Module):
    """Scores directions of gravity by the tokens of an image. ``dropout`` works in training only."""

    def __init__(self, width: int, dim: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.drop = nn.Dropout2d(dropout)
        self.tokens = nn.Conv2d(width, dim, 1)
        self.around = nn.Conv2d(dim, dim, 3, padding=1)
        self.field = nn.Conv2d(GRAVITY_CHANNELS, dim, 1)
        self.together = nn.Conv2d(dim, dim, 3, padding=1)
        self.out = nn.Linear(dim, 1)

    def forward(self, tokens: Tensor, fields: Tensor) -> Tensor:
        """Scores ``(B, C)`` of ``C`` directions each.

        Args:
            tokens: ``(B, taps, dim, h, w)``.
            fields: ``(B, C, 4, h, w)``, their :func:`gravity_field` a token.
        """
        seen = F.gelu(self.tokens(self.drop(tokens.flatten(1, 2))))
        seen = seen + F.gelu(self.around(seen))
        field = self.field(fields.flatten(0, 1)).unflatten(0, fields.shape[:2])
        both = F.gelu(seen[:, None] * field).flatten(0, 1)
        both = F.gelu(both + self.together(both))
        scores: Tensor = self.out(both.mean(dim=(2, 3)))
        return scores.reshape(fields.shape[:2])


@dataclass(frozen=True)
class Look:
    """An image as the backbone saw it.

    Attributes:
        tokens: ``(1, taps, dim, h, w)``.
        size: rows and columns of the network's input.
        focal_px: in pixels of that.
        turn_rad: it was turned upright from this roll; 0 as taken.
    """

    tokens: Tensor
    size: tuple[int, int]
    focal_px: float
    turn_rad: float = 0.0

    def seen(self, directions: Floats) -> Floats:
        """Directions ``(..., 3)`` of the camera that took the image, as they are in the turned one."""
        return directions @ so3_exp(np.array([0.0, 0.0, self.turn_rad])).T


def token_fields(directions: Tensor, focal_px: float, rows: int, columns: int) -> Tensor:
    """:func:`gravity_field` ``(C, 4, rows/14, columns/14)`` of directions ``(C, 3)``, a value a token."""
    focal = torch.full((len(directions),), focal_px, device=directions.device)
    return F.avg_pool2d(gravity_field(directions, focal, rows, columns), 2)


def find_down(
    scorer: DownScorer, frames: Sequence[ManhattanFrame], look: Callable[[float], Look]
) -> DownEstimate | None:
    """The likeliest direction of gravity; None where lines offer none.

    It is the mean of the directions within 20 degrees of one, as much as is believed of each, where most
    belief is: lines offer several that differ by a few degrees.

    The image is looked at as taken, and, where more than one direction is likely, turned as each of the two
    likeliest says: what lies on its side is known better once it stands.

    Args:
        frames: what lines offer.
        look: the image turned upright from a roll in radians, or about that.
    """
    if not frames:
        return None
    offered = np.concatenate([np.concatenate([frame.axes, -frame.axes]) for frame in frames])
    support = np.repeat([frame.support.sum() for frame in frames], 6)
    away = np.arccos(np.clip(offered @ _USUAL, -1.0, 1.0))
    log_belief = _scores(scorer, look(0.0), offered) + _SUPPORT_WEIGHT * support - away / _AWAY_RAD
    likeliest = _likeliest(offered, _shares(log_belief))
    if len(likeliest) > 1:
        for down in likeliest:
            log_belief = log_belief + _scores(scorer, look(roll_rad(down)), offered)
    belief = _shares(log_belief)
    around = offered @ offered.T > _SAME
    best = around[int((around @ belief).argmax())]
    down = belief[best] @ offered[best]
    return DownEstimate(down / np.linalg.norm(down), float(belief[best].sum()))


def _scores(scorer: DownScorer, look: Look, offered: Floats) -> Floats:
    """Log probability ``(C,)`` of each direction by what the image shows."""
    directions = torch.from_numpy(look.seen(offered)).float().to(look.tokens.device)
    with torch.inference_mode():
        scores = scorer(look.tokens, token_fields(directions, look.focal_px, *look.size)[None])
        return torch.log_softmax(scores[0], dim=0).cpu().numpy().astype(np.float64)


def _shares(log_belief: Floats) -> Floats:
    belief = np.exp(log_belief - log_belief.max())
    return np.asarray(belief / belief.sum())


def _likeliest(offered: Floats, belief: Floats) -> list[Floats]:
    """The likeliest directions that are far from one another."""
    left, out = belief.copy(), []
    for _ in range(_LOOKED_AT):
        best = int(left.argmax())
        alike = offered @ offered[best] > _ALIKE
        if left[alike].sum() < _NOT_LIKELY:
            break
        out.append(offered[best])
        left[alike] = 0.0
    return out
