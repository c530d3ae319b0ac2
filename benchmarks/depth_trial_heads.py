# SPDX-License-Identifier: Apache-2.0
"""Other heads and losses than the shipped ones, to be compared with them at 1/7 of the resolution."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.dpt import ResidualUnit
from slamdepth.depth.head import HeadShape
from slamdepth.depth.head_layers import FACTOR, USUAL_DEPTH_M
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.training.config import LossConfig
from slamdepth.training.losses import total_loss
from slamdepth.training.mlp import mse_ssim_loss

Loss = Callable[[Tensor, Tensor], Tensor]
"""Of log depth and log spread ``(B, 2, h, w)`` and canonical depth ``(B, h, w)``, 0 unknown."""

_DPT_CHANNELS = 48
_CANONICAL_FOCAL_CELLS = CANONICAL_FOCAL_PX / FACTOR


def _output(channels: int) -> nn.Conv2d:
    out = nn.Conv2d(channels, 2, 1)
    nn.init.normal_(out.weight, std=1e-3)
    out.bias = nn.Parameter(torch.tensor([math.log(USUAL_DEPTH_M), math.log(0.3)]))
    return out


class LinearHead(nn.Module):
    """One pointwise layer over all tokens and class tokens, enlarged twice."""

    def __init__(self, shape: HeadShape, dropout: float) -> None:
        super().__init__()
        self.drop = nn.Dropout2d(dropout)
        self.out = _output(2 * len(shape.taps) * shape.token_dim)

    def coarse(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """As :meth:`slamdepth.depth.head.DepthHead.coarse`, without gravity."""
        del image, field
        x, cls = tokens.flatten(1, 2), class_tokens.flatten(1)[..., None, None]
        x = self.drop(torch.cat([x, cls.expand(-1, -1, *x.shape[2:])], dim=1))
        return F.interpolate(self.out(x), scale_factor=2, mode="bilinear", align_corners=False), x


class DptLikeHead(nn.Module):
    """DPT (Ranftl et al. 2021) made small: three taps, read out with their class tokens, at 1/2, 1
    and 2 times the token grid, fused from deep to shallow."""

    def __init__(self, shape: HeadShape, dropout: float) -> None:
        super().__init__()
        self.drop = nn.Dropout2d(dropout)
        taps = range(len(shape.taps))
        self.read = nn.ModuleList(nn.Conv2d(2 * shape.token_dim, _DPT_CHANNELS, 1) for _ in taps)
        self.refine = nn.ModuleList(ResidualUnit(_DPT_CHANNELS) for _ in taps)
        self.fuse = nn.ModuleList(ResidualUnit(_DPT_CHANNELS) for _ in taps)
        self.last = nn.Conv2d(_DPT_CHANNELS, 32, 3, padding=1)
        self.out = _output(32)

    def coarse(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """As :meth:`slamdepth.depth.head.DepthHead.coarse`, without gravity."""
        del image, field
        rows, columns = tokens.shape[-2:]
        grids = [(2 * rows, 2 * columns)] + [(rows, columns)] * (tokens.shape[1] - 2)
        grids.append(((rows + 1) // 2, (columns + 1) // 2))
        x = None
        for tap in reversed(range(tokens.shape[1])):
            cls = class_tokens[:, tap, :, None, None].expand_as(tokens[:, tap])
            own = self.read[tap](self.drop(torch.cat([tokens[:, tap], cls], dim=1)))
            own = self.refine[tap](F.interpolate(own, size=grids[tap], mode="bilinear", align_corners=False))
            if x is not None:
                own = own + F.interpolate(x, size=grids[tap], mode="bilinear", align_corners=False)
            x = self.fuse[tap](own)
        assert x is not None
        return self.out(F.relu(self.last(x))), x


def normals_too(prediction: Tensor, target_m: Tensor) -> Tensor:
    """The shipped loss and 1 less the cosine between the normals of the two depth maps, where a
    cell and its neighbours to the right and below are known."""
    predicted, sensor = _normals(prediction[:, 0].exp()), _normals(target_m)
    known = target_m > 0
    whole = known[:, :-1, :-1] & known[:, :-1, 1:] & known[:, 1:, :-1]
    missing = 1 - (predicted * sensor).sum(dim=1)
    share = torch.where(whole, missing, 0.0).sum(dim=(1, 2)) / whole.sum(dim=(1, 2)).clamp_min(1)
    return total_loss(prediction, target_m, LossConfig()) + share.mean()


def _normals(depth: Tensor) -> Tensor:
    """Unit normals ``(B, 3, h - 1, w - 1)`` of ``depth (B, h, w)`` seen by the canonical camera."""
    rows, columns = depth.shape[1:]
    y = (torch.arange(rows, device=depth.device) - (rows - 1) / 2) / _CANONICAL_FOCAL_CELLS
    x = (torch.arange(columns, device=depth.device) - (columns - 1) / 2) / _CANONICAL_FOCAL_CELLS
    points = torch.stack([depth * x, depth * y[:, None], depth], dim=1)
    right = points[:, :, :-1, 1:] - points[:, :, :-1, :-1]
    down = points[:, :, 1:, :-1] - points[:, :, :-1, :-1]
    return F.normalize(torch.linalg.cross(right, down, dim=1), dim=1, eps=1e-6)


def mse_ssim(prediction: Tensor, target_m: Tensor) -> Tensor:
    """The dissertation's loss, MSE * exp(1 - SSIM) in metres, on a head of ours."""
    return mse_ssim_loss(prediction[:, 0].exp(), target_m)
