# SPDX-License-Identifier: Apache-2.0
"""How far a depth map's shape may be off, from what the image shows and from the map itself.

A head that learns its own uncertainty knows how well it fits the places it learnt from. This
small network has learnt from errors in places the predicting head had not seen; see
:mod:`slamdepth.training.out_of_fold`. It reads principal components of the backbone's last
tokens, where in the image a pixel lies and how far below the horizon, the relief the head predicts
(what stands out from the frame's median depth is what a head that flattens unknown rooms gets most
wrong), and what the head says itself. Each alone is wrong in its own way, so the two are averaged.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

FEATURES = 13
_LOG_SPREAD = (-4.0, 1.0)
_MIDDLE = -2.0
_AROUND = 5


class Doubt(nn.Module):
    """Log Laplace spread of log depth, pixel by pixel at 1/7 of the resolution.

    Args:
        token_dim: width of the backbone.
        components: principal components of its tokens that are read.
        width: of the two hidden layers.

    Buffers ``centre (token_dim,)`` and ``basis (components, token_dim)`` make the components;
    ``offset`` and ``gain (FEATURES,)`` bring the rest to unit deviation.
    """

    def __init__(self, token_dim: int, components: int, width: int = 32) -> None:
        super().__init__()
        self.centre: Tensor
        self.basis: Tensor
        self.offset: Tensor
        self.gain: Tensor
        self.register_buffer("centre", torch.zeros(token_dim))
        self.register_buffer("basis", torch.zeros(components, token_dim))
        self.register_buffer("offset", torch.zeros(FEATURES))
        self.register_buffer("gain", torch.ones(FEATURES))
        self.hidden1 = nn.Linear(components + FEATURES, width)
        self.hidden2 = nn.Linear(width, width)
        self.out = nn.Linear(width, 1)

    def forward(self, tokens: Tensor, log_depth: Tensor, own: Tensor, sine: Tensor) -> Tensor:
        """``(B, h, w)``, half of it the head's own.

        Args:
            tokens: ``(B, dim, h / 2, w / 2)`` of the last tap.
            log_depth, own: ``(B, h, w)``, what the head predicts, and the log spread it tells itself.
            sine: ``(B, h, w)`` of the angle below the horizon; 0 where gravity is unknown.
        """
        seen = torch.einsum("kc,bchw->bhwk", self.basis, tokens - self.centre[:, None, None])
        seen = seen.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)
        read = torch.cat([seen, self.scaled(features(log_depth, own, sine))], dim=-1)
        return together(own, self.judge(read))

    def scaled(self, read: Tensor) -> Tensor:
        """What :func:`features` gives, ``(..., FEATURES)``, as the layers read it."""
        return (read - self.offset) * self.gain

    def judge(self, read: Tensor) -> Tensor:
        """Log spread ``(...)`` of pixels of which ``(..., components + FEATURES)`` is read."""
        hidden = F.gelu(self.hidden2(F.gelu(self.hidden1(read))))
        return (self.out(hidden)[..., 0] + _MIDDLE).clamp(*_LOG_SPREAD)


def together(own: Tensor, judged: Tensor) -> Tensor:
    """The log of the geometric mean of two spreads, given their logs."""
    return 0.5 * (own + judged)


def features(log_depth: Tensor, own: Tensor, sine: Tensor) -> Tensor:
    """``(B, h, w, FEATURES)`` of maps ``(B, h, w)``, see :meth:`Doubt.forward`: log depth over the frame's
    median, its size and square, its slopes, and the place in the image; the head's own log spread, as it
    is and smoothed, less its mean; ``sine``."""
    batch, rows, columns = log_depth.shape
    above = log_depth - log_depth.flatten(1).median(dim=1).values[:, None, None]
    down, right = torch.gradient(log_depth, dim=(1, 2))
    slope = torch.hypot(down, right)
    y = torch.linspace(-1, 1, rows, device=log_depth.device)[None, :, None].expand(batch, -1, columns)
    x = torch.linspace(-1, 1, columns, device=log_depth.device)[None, None].expand(batch, rows, -1)
    smooth = F.avg_pool2d(own[:, None], _AROUND, 1, _AROUND // 2, count_include_pad=False)[:, 0]
    mean = own.mean(dim=(1, 2), keepdim=True)
    return torch.stack(
        [above, above.abs(), above.square(), down, right, (slope + 0.01).log(), y, x.abs(), y * y, x * x,
         own - mean, smooth - mean, sine],
        dim=-1,
    )  # fmt: skip
