# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of an image's scale, fitted to the errors of a head in places that it was not trained on.

See :mod:`slamdepth.depth.scale_uncertainty` for what is fitted. Images of one place have one bias, so a place
counts by the root of its images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import HeadEnsemble
from slamdepth.depth.model import Dinov2Depth
from slamdepth.depth.scale_uncertainty import COMPONENTS, ScaleUncertainty, scale_tap
from slamdepth.types import Frame
from slamdepth.typing import Floats

_NEAR_M, _FAR_M = 0.1, 10.0
_MIN_PIXELS = 100
_TOKENS_PER_VIEW = 32
_PARTS = 3
_STEPS, _RATE, _RIDGE = 400, 0.05, 0.02
_ONE_SIGMA = 0.6827
_LIMIT_QUANTILE = 0.995
"""Share of the unseen images that are near enough to the known ones for a scale."""


@dataclass(frozen=True)
class View:
    """What a head makes of an image with known depth.

    Attributes:
        error: median over the pixels of log predicted less log true depth.
        tokens: ``(N, token_dim)`` half-precision tokens that the distance is measured of.
        log_spread: mean log spread of the pixels as the heads predict it themselves.
        log_focal: log of the focal length in pixels of the network's input.
        place: number of the place.
    """

    error: float
    tokens: Tensor
    log_spread: float
    log_focal: float
    place: int


@dataclass(frozen=True)
class ScaleErrors:
    """Scale errors of unseen images.

    Attributes:
        error: ``(N,)`` median over an image's pixels of log predicted less log true depth.
        distance, log_spread, log_focal: ``(N,)``, the inputs of :class:`ScaleUncertainty`.
        place: ``(N,)`` number of the place.
    """

    error: Tensor
    distance: Tensor
    log_spread: Tensor
    log_focal: Tensor
    place: Tensor

    @staticmethod
    def of(network: ScaleUncertainty, views: Sequence[View]) -> ScaleErrors:
        """The errors of ``views``, whose distances are those from the subspace of ``network``."""
        columns = np.array([[v.error, v.log_spread, v.log_focal] for v in views])
        error, log_spread, log_focal = torch.from_numpy(columns).T
        distance = torch.tensor([_distance(network, view) for view in views], dtype=torch.float64)
        return ScaleErrors(error, distance, log_spread, log_focal, torch.tensor([v.place for v in views]))

    @staticmethod
    def joined(parts: Sequence[ScaleErrors]) -> ScaleErrors:
        """All of several parts."""
        names = ScaleErrors.__dataclass_fields__
        return ScaleErrors(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def sigma(self, network: ScaleUncertainty) -> Tensor:
        """Sigma ``(N,)`` of each image."""
        sigma: Tensor = network(self.distance, self.log_spread, self.log_focal)
        return sigma


def _distance(network: ScaleUncertainty, view: View) -> float:
    return float(network.distance(view.tokens.float().T[None, :, :, None])[0])


def look(backbone: DinoV2, head: HeadEnsemble, frames: Iterable[tuple[int, Frame]]) -> list[View]:
    """Predict the depth of frames with a sensor's.

    Args:
        backbone: in eval mode.
        head: its uncertainty of the scale, if it has one, is replaced by an unfitted one.
        frames: number of the place and frame; one with too little depth is left out.
    """
    head.scale = ScaleUncertainty(head.shape.token_dim, COMPONENTS)
    seen: dict[str, Tensor] = {}

    def keep_tokens(module: object, inputs: tuple[Tensor, ...]) -> None:
        seen["tokens"] = inputs[0][0, scale_tap(inputs[0].shape[1])].flatten(1).T.half()

    def keep_inputs(module: object, inputs: tuple[Tensor, ...], sigma: Tensor) -> None:
        seen["spread"], seen["focal"] = inputs[1][0], inputs[2][0]

    hooks = [head.register_forward_pre_hook(keep_tokens), head.scale.register_forward_hook(keep_inputs)]
    model = Dinov2Depth(backbone, head, ())
    views = []
    for place, frame in frames:
        predicted, true_m = model.predict(frame).values, frame.depth_m
        if true_m is None:
            continue
        known = (true_m > _NEAR_M) & (true_m < _FAR_M)
        if int(known.sum()) < _MIN_PIXELS:
            continue
        error = float(np.median(np.log(predicted[known]) - np.log(true_m[known])))
        views.append(View(error, seen["tokens"], float(seen["spread"]), float(seen["focal"]), place))
    for hook in hooks:
        hook.remove()
    return views


def fit_subspace(network: ScaleUncertainty, views: Sequence[View], seed: int = 0) -> None:
    """Set the subspace of ``network``: principal components of some tokens of each view.

    Args:
        network: changed in place.
        seed: of the chosen tokens.
    """
    rng = np.random.default_rng([seed, 31])
    some = []
    for view in views:
        count = len(view.tokens)
        some.append(view.tokens[rng.choice(count, min(_TOKENS_PER_VIEW, count), replace=False)])
    tokens = torch.cat(some).float()
    network.centre.copy_(tokens.mean(dim=0))
    _, axes = torch.linalg.eigh(torch.cov(tokens.T))
    network.basis.copy_(axes.flip(1)[:, : len(network.basis)].T)


def fit_scale_uncertainty(
    known: Sequence[View], unseen: Sequence[View], seen: Sequence[View] = ()
) -> tuple[ScaleUncertainty, ScaleErrors]:
    """Fit the uncertainty of a head's scale.

    Args:
        known: views like those it was trained on; they widen the subspace and the range of focal lengths.
        unseen: views of places that it was not trained on, in the order of their places. Each third of them
            is at its distance from the subspace of all other views.
        seen: views of as many different places that it was trained on, in the same order. Their distances,
            measured alike, count for the limit, and their errors do not count.

    Returns:
        The fitted network and the errors it was fitted to.
    """
    dim = unseen[0].tokens.shape[1]
    parts, distances = [], []
    for (unseen_out, unseen_in), (seen_out, seen_in) in zip(_thirds(unseen), _thirds(seen), strict=True):
        network = ScaleUncertainty(dim, min(COMPONENTS, dim))
        fit_subspace(network, [*known, *unseen_in, *seen_in])
        parts.append(ScaleErrors.of(network, unseen_out))
        distances += [*parts[-1].distance.tolist(), *(_distance(network, view) for view in seen_out)]
    errors = ScaleErrors.joined(parts)
    network = ScaleUncertainty(dim, min(COMPONENTS, dim))
    every = [*known, *unseen, *seen]
    fit_subspace(network, every)
    fit_weights(network, errors)
    network.limit.fill_(float(np.quantile(distances, _LIMIT_QUANTILE)))
    focal = [view.log_focal for view in every]
    network.focal.copy_(torch.tensor([min(focal), max(focal)]))
    return network, errors


def _thirds(views: Sequence[View]) -> list[tuple[Sequence[View], list[View]]]:
    """Each third of ``views`` in their order, and the others."""
    bounds = np.linspace(0, len(views), _PARTS + 1).round().astype(int)
    return [(views[first:end], [*views[:first], *views[end:]]) for first, end in pairwise(bounds)]


def fit_weights(network: ScaleUncertainty, errors: ScaleErrors) -> None:
    """Fit sigma to ``errors`` by Gaussian likelihood, then scale it so that 68 % of them lie within it.

    Args:
        network: changed in place; its subspace stays.
        errors: of unseen images.
    """
    counts = torch.bincount(errors.place).double()
    weight = counts[errors.place].sqrt().reciprocal()
    weight = weight / weight.sum()
    inputs = torch.stack([errors.distance, errors.log_spread], dim=1)
    mean = (weight[:, None] * inputs).sum(dim=0)
    deviation = (weight[:, None] * (inputs - mean).square()).sum(dim=0).sqrt().clamp_min(1e-6)
    network.standard.copy_(torch.stack([mean, deviation]))
    network.limit.fill_(float(errors.distance.quantile(_LIMIT_QUANTILE)))
    network.focal.copy_(torch.stack([errors.log_focal.min(), errors.log_focal.max()]))
    standard = (inputs - mean) / deviation
    standard[:, 0].clamp_min_(0)
    raw = torch.tensor([float(np.log(0.2)), 0.1, 0.1], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([raw], lr=_RATE)
    for _ in range(_STEPS):
        log_sigma = raw[0] + standard @ raw[1:].clamp_min(0.0)
        loss = (weight * (log_sigma + 0.5 * errors.error.square() * (-2 * log_sigma).exp())).sum()
        loss = loss + _RIDGE * raw[1:].square().sum()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    with torch.no_grad():
        raw[1:].clamp_min_(0.0)
        ratio = errors.error.abs() * (-(raw[0] + standard @ raw[1:])).exp()
        raw[0] += float(np.log(_weighted_quantile(ratio.numpy(), weight.numpy(), _ONE_SIGMA)))
        network.weights.copy_(raw)


def _weighted_quantile(values: Floats, weights: Floats, share: float) -> float:
    order = np.argsort(values)
    return float(np.interp(share, np.cumsum(weights[order]), values[order]))
