# SPDX-License-Identifier: Apache-2.0
"""The two stages of a training: judged at 1/7 of the resolution, then at all of it."""

from __future__ import annotations

import torch
from torch import Tensor

from slamdepth.depth.head import DepthHead
from slamdepth.depth.head_layers import FACTOR
from slamdepth.training.config import HeadConfig

FINE_COST = 5
"""A step at full resolution costs about so many at 1/7."""

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Tokens, class tokens, normalised images, gravity fields and canonical depth; see :func:`load_batch`."""


def predict(head: DepthHead, batch: Batch, is_fine: bool) -> tuple[Tensor, Tensor]:
    """Log depth and log spread ``(B, 2, h, w)`` and the depth ``(B, h, w)`` to judge them by, both
    at full resolution or at 1/7."""
    tokens, class_tokens, image, field, target = batch
    if is_fine:
        return head(tokens, class_tokens, image, field), target
    return head.coarse(tokens, class_tokens, image, field)[0], coarse_target(target)


def not_always_told(batch: Batch, config: HeadConfig) -> Batch:
    """``batch`` with the gravity fields of a random share of its samples zeroed: unknown.

    A head that is never told where down is gets it as it is.
    """
    if not config.gravity:
        return batch
    tokens, class_tokens, image, field, target = batch
    is_told = (torch.rand(len(field), 1, 1, 1) >= config.unknown_gravity).to(field)
    return tokens, class_tokens, image, field * is_told, target


def coarse_target(target: Tensor) -> Tensor:
    """Median of the known depths of each 7 x 7 block of ``(B, H, W)``; 0 where there are none."""
    batch, rows, columns = target.shape
    blocks = target.reshape(batch, rows // FACTOR, FACTOR, columns // FACTOR, FACTOR)
    blocks = blocks.permute(0, 1, 3, 2, 4).flatten(3)
    known = torch.where(blocks > 0, blocks, torch.nan)
    return known.nanmedian(dim=-1).values.nan_to_num(0.0)
