# SPDX-License-Identifier: Apache-2.0
"""Uncertainty learnt from errors in places that the predicting head has not seen.

Every source whose views are not mixed is left out once: a head learns from the other such
sources, predicts the one left out, and what it gets wrong there, after the view's median is taken
out, is what a :class:`~slamdepth.depth.doubt.Doubt` learns to foresee. How wrong a whole view is
is divided out, so that it learns which pixels of a view are surer than others.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from slamdepth.depth.doubt import Doubt, relief
from slamdepth.depth.head import DepthHead
from slamdepth.depth.training.caches import PlannedCache
from slamdepth.depth.training.features import FeatureCache, load_batch
from slamdepth.depth.training.progress import Progress, TrainStep
from slamdepth.depth.training.stages import coarse_target
from slamdepth.errors import ConfigError, DatasetError

logger = logging.getLogger(__name__)

COMPONENTS = 16
_PIXELS = 96
_FEWEST = 20
_VIEWS_AT_ONCE = 10
_STEPS, _BATCH, _RATE, _DECAY = 600, 4096, 3e-3, 1e-2
_ONE_SIGMA = 0.6827


@dataclass(frozen=True)
class Fold:
    """Indices of the planned caches that a head learns from, and of the one it is tried on."""

    learnt: tuple[int, ...]
    left_out: int


def plan_folds(planned: Sequence[PlannedCache]) -> list[Fold]:
    """Each source with unmixed views left out once.

    Raises:
        ConfigError: no source would be left to learn from.
    """
    plain = [
        k
        for k, plan in enumerate(planned)
        if plan.held_out is None and plan.teaches != "down" and not plan.view.augment.mixed
    ]
    places = [{place.fingerprint for place in plan.places} for plan in planned]
    folds = []
    for left_out in plain:
        learnt = tuple(k for k in plain if not places[k] & places[left_out])
        if learnt:
            folds.append(Fold(learnt, left_out))
    if len(folds) < 2:
        raise ConfigError(
            "setting 'uncertainty': out_of_fold needs two sources of different places whose views are not "
            "mixed; each is left out once"
        )
    return folds


@dataclass(frozen=True)
class Errors:
    """Pixels of views that the predicting head had not seen places of.

    Attributes:
        tokens: ``(N, dim)`` float16, of the last tap.
        relief: ``(N, RELIEF)``.
        error: ``(N,)`` size of the log error, after the view's median.
        share: ``(N,)`` the same over the view's mean.
        own: ``(N,)`` log spread that the predicting head tells itself.
        place: ``(N,)`` counted over all sources.
        view: ``(N,)``.
    """

    tokens: Tensor
    relief: Tensor
    error: Tensor
    share: Tensor
    own: Tensor
    place: Tensor
    view: Tensor


_FIELDS = tuple(Errors.__dataclass_fields__)


def errors_of(head: DepthHead, cache: FeatureCache, seed: Sequence[int], device: str) -> Errors:
    """Up to ``_PIXELS`` random pixels of each view of ``cache`` at 1/7 of the resolution.

    Raises:
        DatasetError: no view has depth.
    """
    rng = np.random.default_rng(list(seed))
    parts: list[tuple[Tensor, ...]] = []
    for start in range(0, len(cache), _VIEWS_AT_ONCE):
        chosen = np.arange(start, min(start + _VIEWS_AT_ONCE, len(cache)))
        tokens, class_tokens, image, field, depth = load_batch(cache, chosen, device)
        with torch.inference_mode():
            log_depth, own = head.coarse(tokens, class_tokens, image, field)[0].cpu().unbind(dim=1)
        target, last, shapes = coarse_target(depth).cpu(), tokens[:, -1].cpu(), relief(log_depth)
        for k, view in enumerate(chosen):
            known = torch.nonzero(target[k] > 0)
            if len(known) < _FEWEST:
                continue
            error = log_depth[k][target[k] > 0] - target[k][target[k] > 0].log()
            error = (error - error.median()).abs()
            some = torch.from_numpy(rng.choice(len(known), min(_PIXELS, len(known)), replace=False))
            row, column = known[some].unbind(dim=1)
            parts.append((
                last[k][:, row // 2, column // 2].T.half(), shapes[k][row, column], error[some],
                error[some] / error.mean().clamp_min(1e-6), own[k][row, column],
                torch.full((len(some),), int(cache.place[view])), torch.full((len(some),), int(view)),
            ))  # fmt: skip
    if not parts:
        raise DatasetError("a source has no view with enough depth to learn an uncertainty from")
    return Errors(*(torch.cat(part) for part in zip(*parts, strict=True)))


def join(parts: Sequence[Errors]) -> Errors:
    """The errors of several folds, their places and views counted on."""
    place = view = 0
    moved = []
    for part in parts:
        moved.append(replace(part, place=part.place + place, view=part.view + view))
        place, view = place + int(part.place.max()) + 1, view + int(part.view.max()) + 1
    return Errors(*(torch.cat([getattr(part, name) for part in moved]) for name in _FIELDS))


def fit_doubt(errors: Errors, seed: int, told: Callable[[int], None] = lambda _: None) -> Doubt:
    """Learn log spread by Laplace likelihood (Kendall and Gal 2017) of the errors' shares in a
    view's mean error, times the mean of all.

    Args:
        told: called with the number of steps done, of ``_STEPS``.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        doubt = Doubt(errors.tokens.shape[1], min(COMPONENTS, errors.tokens.shape[1]))
        tokens = errors.tokens.float()
        doubt.centre.copy_(tokens.mean(dim=0))
        variance, axes = torch.linalg.eigh(torch.cov(tokens.T))
        most = torch.arange(len(variance) - 1, len(variance) - 1 - len(doubt.basis), -1)
        doubt.basis.copy_((axes[:, most] / variance[most].clamp_min(1e-6).sqrt()).T)
        doubt.offset.copy_(errors.relief.mean(dim=0))
        doubt.gain.copy_(1 / errors.relief.std(dim=0).clamp_min(1e-4))
        features = features_of(doubt, errors)
        target = errors.share * errors.error.mean()
        optimiser = torch.optim.AdamW(doubt.parameters(), lr=_RATE, weight_decay=_DECAY)
        for step in range(_STEPS):
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / _STEPS)
            some = torch.randint(len(target), (_BATCH,))
            spread = doubt.judge(features[some])
            loss = (target[some] * (-spread).exp() + spread).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            told(step + 1)
    return doubt.eval().requires_grad_(False)


def features_of(doubt: Doubt, errors: Errors) -> Tensor:
    """What ``doubt`` reads of each pixel, ``(N, components + RELIEF)``."""
    seen = (errors.tokens.float() - doubt.centre) @ doubt.basis.T
    return torch.cat([seen, doubt.scaled(errors.relief)], dim=1)


def sigma_scale(doubt: Doubt, errors: Errors) -> float:
    """The factor that makes sigma cover 68 % of the errors after the view's median: the mean over
    places, each of which counts the same."""
    ratio = errors.error / (math.sqrt(2.0) * doubt.judge(features_of(doubt, errors)).exp())
    places = [ratio[errors.place == place] for place in errors.place.unique()]
    return float(np.mean([np.quantile(of_place.numpy(), _ONE_SIGMA) for of_place in places]))


def surest_half(doubted_by: Tensor, errors: Errors) -> float:
    """Mean over the views of the error of the surest half of their pixels over that of all.

    Args:
        doubted_by: ``(N,)``, the larger the less sure.
    """
    found = []
    for view in errors.view.unique():
        mine = errors.view == view
        error, doubted = torch.expm1(errors.error[mine]), doubted_by[mine]
        found.append(float(error[doubted <= doubted.median()].mean() / error.mean().clamp_min(1e-9)))
    return float(np.mean(found))


def of_places(errors: Errors, chosen: Tensor) -> Errors:
    """The pixels where ``chosen (N,)`` is true."""
    return Errors(*(getattr(errors, name)[chosen] for name in _FIELDS))


def learn_doubt(
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
    folds: Sequence[Fold],
    train: Callable[[int, list[FeatureCache]], DepthHead],
    *,
    seed: int,
    device: str,
    progress: Progress,
) -> tuple[Doubt, float, dict[str, dict[str, float]]]:
    """The whole way: heads without a source each, their errors on it, the doubt learnt from all.

    Args:
        train: makes the head of a fold, by number, from caches.

    Returns:
        The doubt, the factor on its sigma, and by place :func:`surest_half` by a doubt that has
        learnt nothing of that place (``out_of_fold``), by what the head that has not seen the
        source tells itself (``own``), and by how far a pixel's depth is from the median (``relief``).
    """
    parts, names = [], []
    for number, fold in enumerate(folds):
        head = train(number, [caches[k] for k in fold.learnt]).eval()
        part = errors_of(head, caches[fold.left_out], [seed, number], device)
        parts.append(part)
        names += [place.name for place in planned[fold.left_out].places][: int(part.place.max()) + 1]
        progress(TrainStep("errors in places left out", number + 1, len(folds)))
    errors = join(parts)
    doubt = fit_doubt(errors, seed, lambda step: progress(TrainStep("uncertainty", step, _STEPS)))
    unseen: dict[str, dict[str, float]] = {}
    for place in errors.place.unique().tolist():
        mine = errors.place == place
        without, there = fit_doubt(of_places(errors, ~mine), seed), of_places(errors, mine)
        unseen[names[place]] = {
            "out_of_fold": surest_half(without.judge(features_of(without, there)), there),
            "own": surest_half(there.own, there),
            "relief": surest_half(there.relief[:, 1], there),
        }
        logger.info("surest half in %s, not learnt from: %s", names[place], unseen[names[place]])
        progress(TrainStep("uncertainty without a place", len(unseen), len(errors.place.unique())))
    return doubt, sigma_scale(doubt, errors), unseen
