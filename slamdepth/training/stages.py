# SPDX-License-Identifier: Apache-2.0
"""The two stages of a training: the loss at 1/7 resolution, then at full resolution."""

from __future__ import annotations

import torch
from torch import Tensor

from slamdepth.depth.head import DepthHead
from slamdepth.depth.head_layers import FACTOR
from slamdepth.training.config import HeadConfig

FINE_COST = 5
"""Cost of a step at full resolution, in steps at 1/7."""

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Tokens, class tokens, normalised images, gravity fields and canonical depth; see :func:`load_batch`."""


def predict(head: DepthHead, batch: Batch, is_fine: bool) -> tuple[Tensor, Tensor]:
    """Prediction ``(B, 2, h, w)``, log depth and log spread, and target depth ``(B, h, w)``.

    Args:
        is_fine: both at full resolution; else at 1/7.
    """
    tokens, class_tokens, image, field, target = batch
    if is_fine:
        return head(tokens, class_tokens, image, field), target
    return head.coarse(tokens, class_tokens, image, field)[0], coarse_target(target)


def hide_gravity(batch: Batch, config: HeadConfig) -> Batch:
    """``batch`` with the gravity field of a random share of its samples zeroed, which means unknown.

    Unchanged for a head that does not take gravity.
    """
    if not config.gravity:
        return batch
    tokens, class_tokens, image, field, target = batch
    is_known = (torch.rand(len(field), 1, 1, 1) >= config.unknown_gravity).to(field)
    return tokens, class_tokens, image, field * is_known, target


def coarse_target(target: Tensor) -> Tensor:
    """Median of the known depths in each 7 x 7 block of ``target (B, H, W)``; 0 if there are none."""
    batch, rows, columns = target.shape
    blocks = target.reshape(batch, rows // FACTOR, FACTOR, columns // FACTOR, FACTOR)
    blocks = blocks.permute(0, 1, 3, 2, 4).flatten(3)
    known = torch.where(blocks > 0, blocks, torch.nan)
    return known.nanmedian(dim=-1).values.nan_to_num(0.0)
