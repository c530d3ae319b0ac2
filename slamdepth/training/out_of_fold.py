# SPDX-License-Identifier: Apache-2.0
"""Uncertainty learnt from errors in places that the predicting head has not seen.

Every place is left out once, a third of them at a time: a head learns from the others, predicts views of
those left out that are not mixed, and what it gets wrong there, after the view's median is taken out, is
what a :class:`~slamdepth.depth.uncertainty.UncertaintyNet` learns to foresee.
How wrong a whole view is is divided out,
so that it learns which pixels of a view are surer than others. (What was mixed into a view that a head
learns from may be of a place left out.)
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slamdepth.depth.head import DepthHead
from slamdepth.depth.uncertainty import UncertaintyNet, features, mean_log_spread
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.training.caches import PlannedCache
from slamdepth.training.features import FeatureCache, load_batch
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.training.stages import coarse_target

logger = logging.getLogger(__name__)

COMPONENTS = 16
_FOLDS = 3
PIXELS = 96
"""Of a view, that a doubt learns from."""
_FEWEST = 20
_VIEWS_AT_ONCE = 10
_STEPS, _BATCH, _RATE, _DECAY = 300, 2048, 3e-3, 0.3
_ONE_SIGMA = 0.6827


@dataclass(frozen=True)
class Fold:
    """Samples of each planned cache, ``(n,)`` indices, that a head learns from, and that it is tried on."""

    learnt: tuple[NDArray[np.int64], ...]
    left_out: tuple[NDArray[np.int64], ...]


def plan_folds(planned: Sequence[PlannedCache]) -> list[Fold]:
    """Each place that has views that are not mixed left out once, in all that is made of it.

    Raises:
        ConfigError: there are not two such places.
    """
    teaching = [plan.held_out is None and plan.teaches != "down" for plan in planned]
    plain = [is_one and not plan.view.augment.mixed for plan, is_one in zip(planned, teaching, strict=True)]
    fold_of: dict[str, int] = {}
    for plan, is_one in zip(planned, plain, strict=True):
        for place in plan.places if is_one else ():
            fold_of.setdefault(place.fingerprint, len(fold_of) % _FOLDS)
    if len(fold_of) < 2:
        raise ConfigError(
            "setting 'uncertainty': out_of_fold needs two places whose views are not mixed; each is left out "
            "once"
        )
    folds = []
    for fold in range(min(_FOLDS, len(fold_of))):
        learnt, left_out = [], []
        for plan, is_teaching, is_plain in zip(planned, teaching, plain, strict=True):
            of_place = [fold_of.get(place.fingerprint) == fold for place in plan.places]
            is_out = np.array([of_place[key.place] for key in plan.keys], dtype=bool)
            learnt.append(np.flatnonzero(~is_out & is_teaching))
            left_out.append(np.flatnonzero(is_out & is_plain))
        folds.append(Fold(tuple(learnt), tuple(left_out)))
    return folds


@dataclass(frozen=True)
class Errors:
    """Pixels of views that the predicting head had not seen places of.

    Attributes:
        tokens: ``(N, dim)`` float16, of the last tap.
        features: ``(N, FEATURES)``.
        error: ``(N,)`` size of the log error, after the view's median.
        share: ``(N,)`` the same over the view's mean.
        own: ``(N,)`` log spread that the predicting head tells itself.
        place: ``(N,)`` counted over all that were left out.
        view: ``(N,)``.
    """

    tokens: Tensor
    features: Tensor
    error: Tensor
    share: Tensor
    own: Tensor
    place: Tensor
    view: Tensor


_FIELDS = tuple(Errors.__dataclass_fields__)


def errors_of(
    head: DepthHead,
    cache: FeatureCache,
    views: NDArray[np.int64],
    numbers: Sequence[int],
    seed: Sequence[int],
    device: str,
) -> Errors | None:
    """Up to ``PIXELS`` random pixels of each of ``views (n,)`` of ``cache`` at 1/7 of the resolution; None
    where no view has enough depth.

    Args:
        numbers: what the cache's places count as.
    """
    rng = np.random.default_rng(list(seed))
    parts: list[tuple[Tensor, ...]] = []
    for start in range(0, len(views), _VIEWS_AT_ONCE):
        chosen = views[start : start + _VIEWS_AT_ONCE]
        tokens, class_tokens, image, field, depth = load_batch(cache, chosen, device)
        with torch.inference_mode():
            log_depth, own = head.coarse(tokens, class_tokens, image, field)[0].cpu().unbind(dim=1)
        target, last = coarse_target(depth).cpu(), tokens[:, -1].cpu()
        read = features(log_depth, own, field[:, 0].cpu())
        for k, view in enumerate(chosen):
            known = torch.nonzero(target[k] > 0)
            if len(known) < _FEWEST:
                continue
            error = log_depth[k][target[k] > 0] - target[k][target[k] > 0].log()
            error = (error - error.median()).abs()
            some = torch.from_numpy(rng.choice(len(known), min(PIXELS, len(known)), replace=False))
            row, column = known[some].unbind(dim=1)
            parts.append((
                last[k][:, row // 2, column // 2].T.half(), read[k][row, column], error[some],
                error[some] / error.mean().clamp_min(1e-6), own[k][row, column],
                torch.full((len(some),), numbers[int(cache.place[view])]),
                torch.full((len(some),), int(view)),
            ))  # fmt: skip
    return Errors(*(torch.cat(part) for part in zip(*parts, strict=True))) if parts else None


def join(parts: Sequence[Errors]) -> Errors:
    """The errors of several caches and folds, their views counted on."""
    view = 0
    moved = []
    for part in parts:
        moved.append(replace(part, view=part.view + view))
        view += int(part.view.max()) + 1
    return Errors(*(torch.cat([getattr(part, name) for part in moved]) for name in _FIELDS))


def fit_doubt(
    errors: Errors, seed: int, told: Callable[[int], None] = lambda _: None, *, steps: int | None = None
) -> UncertaintyNet:
    """Learn log spread by Laplace likelihood (Kendall and Gal 2017) of the errors' shares in a
    view's mean error, times the mean of all. Each place counts the same.

    Args:
        told: called with the number of steps done.
        steps: how many; None: ``_STEPS``.
    """
    steps = _STEPS if steps is None else steps
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        doubt = UncertaintyNet(errors.tokens.shape[1], min(COMPONENTS, errors.tokens.shape[1]))
        tokens = errors.tokens.float()
        doubt.centre.copy_(tokens.mean(dim=0))
        variance, axes = torch.linalg.eigh(torch.cov(tokens.T))
        most = torch.arange(len(variance) - 1, len(variance) - 1 - len(doubt.basis), -1)
        doubt.basis.copy_((axes[:, most] / variance[most].clamp_min(1e-6).sqrt()).T)
        doubt.offset.copy_(errors.features.mean(dim=0))
        doubt.gain.copy_(1 / errors.features.std(dim=0).clamp_min(1e-4))
        read = read_by(doubt, errors)
        target = errors.share * errors.error.mean()
        places = [torch.nonzero(errors.place == place)[:, 0] for place in errors.place.unique()]
        optimiser = torch.optim.AdamW(doubt.parameters(), lr=_RATE, weight_decay=_DECAY)
        for step in range(steps):
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / steps)
            some = torch.cat([of[torch.randint(len(of), (_BATCH // len(places),))] for of in places])
            spread = doubt.log_spread(read[some])
            loss = (target[some] * (-spread).exp() + spread).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            told(step + 1)
    return doubt.eval().requires_grad_(False)


def read_by(doubt: UncertaintyNet, errors: Errors) -> Tensor:
    """What ``doubt`` reads of each pixel, ``(N, components + FEATURES)``."""
    seen = (errors.tokens.float() - doubt.centre) @ doubt.basis.T
    return torch.cat([seen, doubt.standardised(errors.features)], dim=1)


def spread_of(doubt: UncertaintyNet, errors: Errors) -> Tensor:
    """Log spread ``(N,)`` that a head with ``doubt`` tells of each pixel."""
    return mean_log_spread(errors.own, doubt.log_spread(read_by(doubt, errors)))


def sigma_scale(doubt: UncertaintyNet, errors: Errors) -> float:
    """The factor that makes sigma cover 68 % of the errors after the view's median: the mean over
    places, each of which counts the same."""
    ratio = errors.error / (math.sqrt(2.0) * spread_of(doubt, errors).exp())
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
    train: Callable[[int, tuple[NDArray[np.int64], ...]], DepthHead],
    *,
    seed: int,
    device: str,
    progress: Progress,
) -> tuple[UncertaintyNet, float, dict[str, dict[str, float]]]:
    """The whole way: heads without some places each, their errors there, the doubt learnt from all.

    Args:
        train: makes the head of a fold, by number, from the samples of each cache.

    Returns:
        The doubt, the factor on its sigma, and by place :func:`surest_half` by what a head says with a
        doubt that has learnt nothing of that place (``out_of_fold``), by what a head that has not seen the
        place says alone (``own``), and by how far a pixel's depth is from the median (``relief``).

    Raises:
        DatasetError: no view has enough depth to learn from.
    """
    parts = []
    names: list[str] = []
    numbers = []  # of each cache's places
    for plan in planned:
        names += [place.name for place in plan.places if place.name not in names]
        numbers.append([names.index(place.name) for place in plan.places])
    for number, fold in enumerate(folds):
        head = train(number, fold.learnt).eval()
        for k, views in enumerate(fold.left_out):
            if (part := errors_of(head, caches[k], views, numbers[k], [seed, number, k], device)) is not None:
                parts.append(part)
        progress(TrainStep("errors in places left out", number + 1, len(folds)))
    if not parts:
        raise DatasetError("no view has enough depth to learn an uncertainty from")
    errors = join(parts)
    doubt = fit_doubt(errors, seed, lambda step: progress(TrainStep("uncertainty", step, _STEPS)))
    unseen: dict[str, dict[str, float]] = {}
    for place in errors.place.unique().tolist():
        mine = errors.place == place
        without, there = fit_doubt(of_places(errors, ~mine), seed), of_places(errors, mine)
        unseen[names[place]] = {
            "out_of_fold": surest_half(spread_of(without, there), there),
            "own": surest_half(there.own, there),
            "relief": surest_half(there.features[:, 1], there),
        }
        logger.info("surest half in %s, not learnt from: %s", names[place], unseen[names[place]])
        progress(TrainStep("uncertainty without a place", len(unseen), len(errors.place.unique())))
    return doubt, sigma_scale(doubt, errors), unseen
