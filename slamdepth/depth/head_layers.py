# SPDX-License-Identifier: Apache-2.0
"""The layers a depth head is built of."""

from __future__ import annotations

import math
from typing import TypeVar

from torch import Tensor, nn
from torch.nn import functional as F

FACTOR = 7
"""Pixels of the input per pixel of the coarse prediction, along a side."""

GRAVITY_CHANNELS = 4
"""Channels of a gravity field, see :func:`~slamdepth.depth.gravity_field.gravity_field`."""

INITIAL_DEPTH_M = 1.8
"""Depth that an untrained head predicts, at the canonical focal length."""

_SCALE_DROPOUT = 0.5
_Layer = TypeVar("_Layer", bound=nn.Module)


class Residual(nn.Module):
    """A depthwise 5 x 5 convolution, then two pointwise ones, as in ConvNeXt (Liu et al. 2022)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.spread = nn.Conv2d(dim, dim, 5, padding=2, groups=dim)
        self.norm = nn.GroupNorm(1, dim)
        self.conv1 = nn.Conv2d(dim, 2 * dim, 1)
        self.conv2 = nn.Conv2d(2 * dim, dim, 1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, dim, h, w)`` to the same shape."""
        residual: Tensor = self.conv2(F.gelu(self.conv1(self.norm(self.spread(x)))))
        return x + residual


class ScaleBranch(nn.Module):
    """Mean log depth of a view, from the mean of its tokens.

    Class tokens are not read: they describe the place rather than the distance, and with them the scale of
    frames scattered more in sequences that were not trained on.

    Args:
        width: channels of all tapped blocks together.
        dim: channels of the hidden layer.
        gravity: the mean of the gravity field is read too.
    """

    def __init__(self, width: int, dim: int, gravity: bool = False) -> None:
        super().__init__()
        self.drop = nn.Dropout(_SCALE_DROPOUT)
        self.hidden = nn.Linear(width, dim)
        self.out = nn.Linear(dim, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.constant_(self.out.bias, math.log(INITIAL_DEPTH_M))
        self.gravity = zeroed(nn.Linear(GRAVITY_CHANNELS, dim)) if gravity else None

    def forward(self, mean_tokens: Tensor, mean_field: Tensor | None = None) -> Tensor:
        """Mean log depth ``(B,)`` at the canonical focal length.

        Args:
            mean_tokens: ``(B, width)``.
            mean_field: ``(B, 4)``, the mean of the view's gravity field.
        """
        hidden = self.hidden(self.drop(F.layer_norm(mean_tokens, mean_tokens.shape[1:])))
        if self.gravity is not None and mean_field is not None:
            hidden = hidden + self.gravity(mean_field)
        out: Tensor = self.out(F.gelu(hidden))
        return out[:, 0]


def zeroed(layer: _Layer) -> _Layer:
    """``layer`` with all its parameters set to 0, so that it starts by adding nothing."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def convex_upsample(coarse: Tensor, logits: Tensor) -> Tensor:
    """Upsample sevenfold by convex combinations of neighbours (Teed and Deng, RAFT, ECCV 2020).

    Args:
        coarse: ``(B, C, h, w)``.
        logits: ``(B, 9 * 49, h, w)``; their softmax weighs the 3 x 3 coarse neighbours of each fine pixel.

    Returns:
        ``(B, C, 7h, 7w)``.
    """
    batch, channels, rows, columns = coarse.shape
    weights = logits.reshape(batch, 1, 9, FACTOR * FACTOR, rows * columns).softmax(dim=2)
    padded = F.pad(coarse, (1, 1, 1, 1), mode="replicate")
    neighbours = F.unfold(padded, 3).reshape(batch, channels, 9, 1, rows * columns)
    fine = (weights * neighbours).sum(dim=2)
    return F.pixel_shuffle(fine.reshape(batch, channels * FACTOR * FACTOR, rows, columns), FACTOR)
