# SPDX-License-Identifier: Apache-2.0
"""How far a depth map's shape may be off, from what the image shows and from the map itself.

A head that learns its own uncertainty knows how well it fits the places it learnt from. This
small network has learnt from errors in places the predicting head had not seen; see
:mod:`slamdepth.depth.training.out_of_fold`. It reads principal components of the backbone's last
tokens, where in the image a pixel lies, and the relief the head predicts: what stands out from
the frame's median depth is what a head that flattens unknown rooms gets most wrong.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

RELIEF = 10
_LOG_SPREAD = (-4.0, 1.0)
_MIDDLE = -2.0


class Doubt(nn.Module):
    """Log Laplace spread of log depth, pixel by pixel at 1/7 of the resolution.

    Args:
        token_dim: width of the backbone.
        components: principal components of its tokens that are read.
        width: of the two hidden layers.

    Buffers ``centre (token_dim,)`` and ``basis (components, token_dim)`` make the components;
    ``offset`` and ``gain (RELIEF,)`` bring the rest to unit deviation.
    """

    def __init__(self, token_dim: int, components: int, width: int = 32) -> None:
        super().__init__()
        self.centre: Tensor
        self.basis: Tensor
        self.offset: Tensor
        self.gain: Tensor
        self.register_buffer("centre", torch.zeros(token_dim))
        self.register_buffer("basis", torch.zeros(components, token_dim))
        self.register_buffer("offset", torch.zeros(RELIEF))
        self.register_buffer("gain", torch.ones(RELIEF))
        self.hidden1 = nn.Linear(components + RELIEF, width)
        self.hidden2 = nn.Linear(width, width)
        self.out = nn.Linear(width, 1)

    def forward(self, tokens: Tensor, log_depth: Tensor) -> Tensor:
        """``(B, h, w)`` from the last tap's ``tokens (B, dim, h / 2, w / 2)`` and the predicted
        ``log_depth (B, h, w)``."""
        seen = torch.einsum("kc,bchw->bhwk", self.basis, tokens - self.centre[:, None, None])
        seen = seen.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)
        return self.judge(torch.cat([seen, self.scaled(relief(log_depth))], dim=-1))

    def scaled(self, features: Tensor) -> Tensor:
        """``features (..., RELIEF)`` of :func:`relief` as the layers read them."""
        return (features - self.offset) * self.gain

    def judge(self, features: Tensor) -> Tensor:
        """Log spread ``(...)`` of pixels with ``features (..., components + RELIEF)``."""
        hidden = F.gelu(self.hidden2(F.gelu(self.hidden1(features))))
        return (self.out(hidden)[..., 0] + _MIDDLE).clamp(*_LOG_SPREAD)


def relief(log_depth: Tensor) -> Tensor:
    """``(B, h, w, RELIEF)`` of ``log_depth (B, h, w)``: log depth over the frame's median, its
    size and square, its slopes, and the place in the image."""
    batch, rows, columns = log_depth.shape
    above = log_depth - log_depth.flatten(1).median(dim=1).values[:, None, None]
    down, right = torch.gradient(log_depth, dim=(1, 2))
    slope = torch.hypot(down, right)
    y = torch.linspace(-1, 1, rows, device=log_depth.device)[None, :, None].expand(batch, -1, columns)
    x = torch.linspace(-1, 1, columns, device=log_depth.device)[None, None].expand(batch, rows, -1)
    return torch.stack(
        [above, above.abs(), above.square(), down, right, (slope + 0.01).log(), y, x.abs(), y * y, x * x],
        dim=-1,
    )
