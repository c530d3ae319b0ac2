# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the scale that a whole predicted image has in common, wider where it is unlike the training.

A head that meets an image of a kind it was never trained on predicts some scale all the same. How unlike the
training an image is shows in its tokens: those of the training images lie close to a linear subspace, and the
tokens of streets or trees stand out of it. The reconstruction error is used as by Ndiour et al.,
"Out-Of-Distribution Detection With Subspace Techniques And Probabilistic Modeling Of Features", 2020.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

COMPONENTS = 64
"""Dimensions of the subspace."""


class ScaleUncertainty(nn.Module):
    """Standard deviation of the log of an image's scale error; infinite where nothing supports a scale.

    ``log sigma = base + by_distance * max(0, d) + by_spread * s``, where ``d`` is the distance of the image's
    tokens from the training's subspace and ``s`` the mean log spread that the heads predict for its pixels,
    both standardised. Beyond the focal lengths that were trained, the log of the ratio to the nearest of them
    is added in squares: a network that does not notice the lens is wrong by that ratio.

    Args:
        token_dim: width of the backbone.
        components: dimensions of the subspace.

    Buffers: ``centre (token_dim,)`` and ``basis (components, token_dim)`` give the subspace, ``standard
    (2, 2)`` the mean and deviation of distance and spread over left-out images, ``weights (3,)`` base,
    by_distance and by_spread, ``limit ()`` the distance from which on sigma is infinite, ``focal (2,)`` the
    smallest and largest log focal length in pixels of the network's input that was trained.
    """

    def __init__(self, token_dim: int, components: int) -> None:
        super().__init__()
        self.centre: Tensor
        self.basis: Tensor
        self.standard: Tensor
        self.weights: Tensor
        self.limit: Tensor
        self.focal: Tensor
        self.register_buffer("centre", torch.zeros(token_dim))
        self.register_buffer("basis", torch.zeros(components, token_dim))
        self.register_buffer("standard", torch.tensor([[0.0, 0.0], [1.0, 1.0]]))
        self.register_buffer("weights", torch.zeros(3))
        self.register_buffer("limit", torch.tensor(torch.inf))
        self.register_buffer("focal", torch.zeros(2))

    def distance(self, tokens: Tensor) -> Tensor:
        """Mean distance ``(B,)`` of an image's tokens ``(B, token_dim, h, w)`` from the subspace."""
        outside = tokens.flatten(2).transpose(1, 2) - self.centre
        outside = outside - (outside @ self.basis.T) @ self.basis
        mean: Tensor = outside.norm(dim=2).mean(dim=1)
        return mean

    def forward(self, distance: Tensor, log_spread: Tensor, log_focal: Tensor) -> Tensor:
        """Sigma ``(B,)``.

        Args:
            distance: ``(B,)``, see :meth:`distance`.
            log_spread: ``(B,)`` mean log spread of an image's pixels as the heads predict it themselves.
            log_focal: ``(B,)`` log of the focal length in pixels of the network's input.
        """
        mean, deviation = self.standard
        inputs = torch.stack([distance, log_spread], dim=1)
        inputs = (inputs - mean) / deviation
        log_sigma = (
            self.weights[0] + self.weights[1] * inputs[:, 0].clamp_min(0) + self.weights[2] * inputs[:, 1]
        )
        beyond = (self.focal[0] - log_focal).clamp_min(0) + (log_focal - self.focal[1]).clamp_min(0)
        sigma = (log_sigma.exp().square() + beyond.square()).sqrt()
        sigma_or_inf: Tensor = torch.where(distance > self.limit, torch.inf, sigma)
        return sigma_or_inf


def scale_tap(taps: int) -> int:
    """Index of the tapped block whose tokens tell how unlike the training an image is: the last but one.

    The last block's tokens are too alike: a street is no farther than a kitchen left out.
    """
    return max(0, taps - 2)
