# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of a depth map's shape, estimated from the image's tokens and from the map itself.

A head that learns its own uncertainty knows how well it fits the places it was trained on. The small network
here is trained on errors in places that the predicting head had not seen; see
:mod:`slamdepth.training.out_of_fold`. Its input is: principal components of the backbone's last tokens, the
position of the pixel in the image and below the horizon, the predicted shape (what stands out from the
frame's median depth is what a head that flattens unknown places gets most wrong), and the head's own
uncertainty. Each of the two estimates is wrong in its own way, so they are averaged.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

FEATURES = 13
_LOG_SPREAD_RANGE = (-4.0, 1.0)
_INITIAL_LOG_SPREAD = -2.0
_SMOOTHING = 5


class UncertaintyNet(nn.Module):
    """Log Laplace spread of log depth for each pixel, at 1/7 of the resolution.

    Args:
        token_dim: width of the backbone.
        components: number of principal components of its tokens.
        width: of the two hidden layers.

    Buffers: ``centre (token_dim,)`` and ``basis (components, token_dim)`` give the components; ``offset`` and
    ``gain (FEATURES,)`` scale the other inputs to zero mean and unit deviation.
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
        """Log spread ``(B, h, w)``: the mean of this network's and the head's own.

        Args:
            tokens: ``(B, dim, h / 2, w / 2)`` of the last tapped block.
            log_depth: ``(B, h, w)`` as the head predicts it.
            own: ``(B, h, w)``, the log spread that the head predicts itself.
            sine: ``(B, h, w)`` of the angle below the horizon; 0 where gravity is unknown.
        """
        components = torch.einsum("kc,bchw->bhwk", self.basis, tokens - self.centre[:, None, None])
        components = components.repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)
        inputs = torch.cat([components, self.standardised(features(log_depth, own, sine))], dim=-1)
        return mean_log_spread(own, self.log_spread(inputs))

    def standardised(self, values: Tensor) -> Tensor:
        """The output of :func:`features`, ``(..., FEATURES)``, with zero mean and unit deviation."""
        return (values - self.offset) * self.gain

    def log_spread(self, inputs: Tensor) -> Tensor:
        """Log spread ``(...)`` of pixels, this network's alone.

        Args:
            inputs: ``(..., components + FEATURES)``, token components and standardised features.
        """
        hidden = F.gelu(self.hidden2(F.gelu(self.hidden1(inputs))))
        out: Tensor = self.out(hidden)
        return (out[..., 0] + _INITIAL_LOG_SPREAD).clamp(*_LOG_SPREAD_RANGE)


def mean_log_spread(own: Tensor, estimated: Tensor) -> Tensor:
    """Mean of two log spreads, which is the log of their geometric mean."""
    return 0.5 * (own + estimated)


def features(log_depth: Tensor, own: Tensor, sine: Tensor) -> Tensor:
    """What :class:`UncertaintyNet` reads of each pixel next to its tokens, not yet standardised.

    Args:
        log_depth: ``(B, h, w)`` as the head predicts it.
        own: ``(B, h, w)``, the log spread that the head predicts itself.
        sine: ``(B, h, w)`` of the angle below the horizon; 0 where gravity is unknown.

    Returns:
        ``(B, h, w, FEATURES)``: log depth over the frame's median, its absolute value and square; its slopes;
        the position in the image; ``own``, raw and smoothed, less its mean; ``sine``.
    """
    batch, rows, columns = log_depth.shape
    relative = log_depth - log_depth.flatten(1).median(dim=1).values[:, None, None]
    slope_y, slope_x = torch.gradient(log_depth, dim=(1, 2))
    slope = torch.hypot(slope_y, slope_x)
    y = torch.linspace(-1, 1, rows, device=log_depth.device)[None, :, None].expand(batch, -1, columns)
    x = torch.linspace(-1, 1, columns, device=log_depth.device)[None, None].expand(batch, rows, -1)
    smooth = F.avg_pool2d(own[:, None], _SMOOTHING, 1, _SMOOTHING // 2, count_include_pad=False)[:, 0]
    mean = own.mean(dim=(1, 2), keepdim=True)
    return torch.stack(
        [relative, relative.abs(), relative.square(), slope_y, slope_x, (slope + 0.01).log(),
         y, x.abs(), y * y, x * x, own - mean, smooth - mean, sine],
        dim=-1,
    )  # fmt: skip
