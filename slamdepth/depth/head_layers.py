# SPDX-License-Identifier: Apache-2.0
"""The parts a depth head is built of."""

from __future__ import annotations

import math
from typing import TypeVar

from torch import Tensor, nn
from torch.nn import functional as F

FACTOR = 7
"""Pixels of the input a side of what the head predicts before the upsampling."""

GRAVITY_CHANNELS = 4
"""Of a gravity field, see :func:`~slamdepth.depth.gravity_field.gravity_field`."""

USUAL_DEPTH_M = 1.8
"""What an untrained head predicts, at the canonical focal length."""

_LEVEL_DROPOUT = 0.5
_Layer = TypeVar("_Layer", bound=nn.Module)


class Residual(nn.Module):
    """Depthwise 5 x 5, then two pointwise convolutions, as in ConvNeXt (Liu et al. 2022)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.spread = nn.Conv2d(dim, dim, 5, padding=2, groups=dim)
        self.norm = nn.GroupNorm(1, dim)
        self.conv1 = nn.Conv2d(dim, 2 * dim, 1)
        self.conv2 = nn.Conv2d(2 * dim, dim, 1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.gelu(self.conv1(self.norm(self.spread(x)))))


class Level(nn.Module):
    """A view's mean log depth ``(B,)`` from its mean tokens ``(B, width)`` and, with ``gravity``, the mean
    ``(B, 4)`` of its gravity field.

    Class tokens tell which place it is rather than how far things are: with them the scale of frames
    scattered more in sequences not learnt from.
    """

    def __init__(self, width: int, dim: int, gravity: bool = False) -> None:
        super().__init__()
        self.drop = nn.Dropout(_LEVEL_DROPOUT)
        self.hidden = nn.Linear(width, dim)
        self.out = nn.Linear(dim, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.constant_(self.out.bias, math.log(USUAL_DEPTH_M))
        self.gravity = zeroed(nn.Linear(GRAVITY_CHANNELS, dim)) if gravity else None

    def forward(self, mean_tokens: Tensor, mean_field: Tensor | None = None) -> Tensor:
        hidden = self.hidden(self.drop(F.layer_norm(mean_tokens, mean_tokens.shape[1:])))
        if self.gravity is not None and mean_field is not None:
            hidden = hidden + self.gravity(mean_field)
        return self.out(F.gelu(hidden))[:, 0]


def zeroed(layer: _Layer) -> _Layer:
    """``layer`` with all its parameters 0, so that it starts by adding nothing."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def convex_upsample(coarse: Tensor, logits: Tensor) -> Tensor:
    """``coarse (B, C, h, w)`` at 7 times the size; ``logits (B, 9 * 49, h, w)`` choose among
    each pixel's 3 x 3 coarse neighbours."""
    batch, channels, rows, columns = coarse.shape
    weights = logits.reshape(batch, 1, 9, FACTOR * FACTOR, rows * columns).softmax(dim=2)
    padded = F.pad(coarse, (1, 1, 1, 1), mode="replicate")
    neighbours = F.unfold(padded, 3).reshape(batch, channels, 9, 1, rows * columns)
    fine = (weights * neighbours).sum(dim=2)
    return F.pixel_shuffle(fine.reshape(batch, channels * FACTOR * FACTOR, rows, columns), FACTOR)
