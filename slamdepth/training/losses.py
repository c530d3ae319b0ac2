# SPDX-License-Identifier: Apache-2.0
"""Losses on log depth. Each term is a mean over an image's known pixels, then over images."""

from __future__ import annotations

import torch
from torch import Tensor

from slamdepth.training.config import LossConfig

_GRADIENT_STEPS = (1, 2, 4, 8, 16)
_LOG_SPREAD_RANGE = (-4.0, 1.5)


def supervised(prediction: Tensor, target_m: Tensor, supervision: Tensor) -> Tensor:
    """``prediction`` with the gradient stopped for what its samples do not supervise.

    The scale of a sample is its mean log depth, its shape the rest. Without supervision of the scale
    the mean error over known pixels is subtracted too, so a wrong scale adds nothing to the loss.

    Args:
        prediction: ``(B, 2, H, W)`` log depth and log Laplace spread, as for :func:`total_loss`.
        target_m: ``(B, H, W)`` depth, 0 where unknown.
        supervision: ``(B, 2)`` of 0 and 1: shape, scale.
    """
    if bool((supervision > 0).all()):
        return prediction
    has_shape, has_scale = (supervision > 0)[:, :, None, None].unbind(dim=1)
    log_depth = prediction[:, 0]
    scale = log_depth.mean(dim=(1, 2), keepdim=True)
    shape = log_depth - scale
    log_depth = torch.where(has_shape, shape, shape.detach()) + torch.where(has_scale, scale, scale.detach())
    known = target_m > 0
    error = torch.where(known, log_depth - target_m.clamp_min(1e-3).log(), 0.0)
    mean = error.sum(dim=(1, 2), keepdim=True) / known.sum(dim=(1, 2), keepdim=True).clamp_min(1)
    return torch.stack([log_depth - torch.where(has_scale, 0.0, mean), prediction[:, 1]], dim=1)


def total_loss(prediction: Tensor, target_m: Tensor, config: LossConfig) -> Tensor:
    """Weighted sum of the loss terms.

    Args:
        prediction: ``(B, 2, H, W)`` log depth and log Laplace spread.
        target_m: ``(B, H, W)`` depth, 0 where unknown.
    """
    known = target_m > 0
    error = torch.where(known, prediction[:, 0] - target_m.clamp_min(1e-3).log(), 0.0)
    loss = prediction.new_zeros(())
    if config.nll:
        loss = loss + config.nll * laplace_nll(error, prediction[:, 1], known)
    if config.scale_invariant:
        loss = loss + config.scale_invariant * scale_invariant(error, known, config.scale_invariant_lambda)
    if config.gradient:
        loss = loss + config.gradient * multiscale_gradient(error, known)
    return loss


def laplace_nll(error: Tensor, log_spread: Tensor, known: Tensor) -> Tensor:
    """Negative log likelihood of ``error (B, H, W)`` under Laplace of spread ``exp(log_spread)``
    (Kendall and Gal 2017)."""
    log_spread = log_spread.clamp(*_LOG_SPREAD_RANGE)
    return _image_mean(error.abs() * (-log_spread).exp() + log_spread, known)


def scale_invariant(error: Tensor, known: Tensor, share: float) -> Tensor:
    """Scale-invariant squared log error (Eigen et al. 2014): the mean square less ``share``
    of the squared mean."""
    count = known.sum(dim=(1, 2)).clamp_min(1)
    mean_square = error.square().sum(dim=(1, 2)) / count
    mean = error.sum(dim=(1, 2)) / count
    return (mean_square - share * mean.square()).mean()


def multiscale_gradient(error: Tensor, known: Tensor) -> Tensor:
    """Mean absolute difference of the log error between pixels 1, 2, 4, 8 and 16 apart
    (after Li and Snavely, MegaDepth 2018)."""
    loss = error.new_zeros(())
    for step in _GRADIENT_STEPS:
        for dim in (1, 2):
            size = error.shape[dim] - step
            if size < 1:
                continue
            difference = error.narrow(dim, step, size) - error.narrow(dim, 0, size)
            both = known.narrow(dim, step, size) & known.narrow(dim, 0, size)
            loss = loss + _image_mean(difference.abs(), both)
    return loss / len(_GRADIENT_STEPS)


def _image_mean(values: Tensor, known: Tensor) -> Tensor:
    total = torch.where(known, values, 0.0).sum(dim=(1, 2))
    return (total / known.sum(dim=(1, 2)).clamp_min(1)).mean()
