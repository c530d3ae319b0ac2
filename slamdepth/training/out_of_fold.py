# SPDX-License-Identifier: Apache-2.0
"""Uncertainty fitted to errors in places that the predicting head was not trained on.

Each place is left out once, a third of them at a time (cross-validation). A head is trained on the other
places and predicts the unmixed views of those left out. The uncertainty
(:mod:`slamdepth.depth.uncertainty`) is fitted to its errors there, after median scaling per view. Errors
are divided by the mean error of their view, so the fit learns which pixels of a view are more certain
than others. A view mixed into a training view may come from a left-out place.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from slamdepth.depth.head import DepthHead
from slamdepth.depth.uncertainty import UncertaintyNet, features, mean_log_spread
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.training.caches import PlannedCache
from slamdepth.training.features import FeatureCache, load_batch
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.training.stages import coarse_target
from slamdepth.typing import Ints

logger = logging.getLogger(__name__)

COMPONENTS = 16
_FOLDS = 3
PIXELS = 96
"""Number of pixels of a view that the uncertainty is fitted to."""
_MIN_PIXELS = 20
_VIEWS_AT_ONCE = 10
_STEPS, _BATCH, _RATE, _DECAY = 300, 2048, 3e-3, 0.3
_ONE_SIGMA = 0.6827


@dataclass(frozen=True)
class Fold:
    """One split of the samples of all planned caches.

    Attributes:
        training: for each cache, the ``(n,)`` samples that the head of this fold is trained on.
        left_out: for each cache, the ``(n,)`` samples that it is evaluated on.
    """

    training: tuple[Ints, ...]
    left_out: tuple[Ints, ...]


def plan_folds(planned: Sequence[PlannedCache]) -> list[Fold]:
    """Splits in which each place with unmixed views is left out once, with all of its samples.

    Raises:
        ConfigError: there are fewer than two such places.
    """
    is_unmixed = [plan.trains_depth and not plan.view.augment.mixed for plan in planned]
    fold_of: dict[str, int] = {}
    for plan, unmixed in zip(planned, is_unmixed, strict=True):
        for place in plan.places if unmixed else ():
            fold_of.setdefault(place.fingerprint, len(fold_of) % _FOLDS)
    if len(fold_of) < 2:
        raise ConfigError(
            "setting 'uncertainty': out_of_fold needs two places whose views are not mixed; each is left out "
            "once"
        )
    folds = []
    for fold in range(min(_FOLDS, len(fold_of))):
        training, left_out = [], []
        for plan, unmixed in zip(planned, is_unmixed, strict=True):
            of_place = [fold_of.get(place.fingerprint) == fold for place in plan.places]
            is_out = np.array([of_place[key.place] for key in plan.keys], dtype=bool)
            training.append(np.flatnonzero(~is_out & plan.trains_depth))
            left_out.append(np.flatnonzero(is_out & unmixed))
        folds.append(Fold(tuple(training), tuple(left_out)))
    return folds


@dataclass(frozen=True)
class Errors:
    """Errors at pixels of left-out views.

    Attributes:
        tokens: ``(N, dim)`` float16, of the last tap.
        features: ``(N, FEATURES)``, see :func:`slamdepth.depth.uncertainty.features`.
        error: ``(N,)`` absolute error of log depth after median scaling of the view.
        share: ``(N,)`` that error over the mean error of its view.
        own: ``(N,)`` log spread predicted by the head itself.
        place: ``(N,)`` number of the place, over all caches.
        view: ``(N,)`` number of the view.
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
    views: Ints,
    numbers: Sequence[int],
    seed: Sequence[int],
    device: str,
) -> Errors | None:
    """Errors at up to ``PIXELS`` random pixels of each view, at 1/7 resolution; None without enough depth.

    Args:
        head: predicts depth.
        cache: has the views.
        views: ``(n,)`` samples of ``cache``.
        numbers: number of each of the cache's places, see :class:`Errors`.
        seed: of the random pixels.
        device: where to compute.
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
            if len(known) < _MIN_PIXELS:
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
    """The errors of several caches and folds, with their views renumbered."""
    view = 0
    moved = []
    for part in parts:
        moved.append(replace(part, view=part.view + view))
        view += int(part.view.max()) + 1
    return Errors(*(torch.cat([getattr(part, name) for part in moved]) for name in _FIELDS))


def fit_uncertainty(
    errors: Errors, seed: int, on_step: Callable[[int], None] = lambda _: None, *, steps: int | None = None
) -> UncertaintyNet:
    """Fit the log spread to ``errors`` by Laplace likelihood (Kendall and Gal 2017).

    The error of a pixel is its share in the mean error of its view times the mean of all errors. Each
    place counts the same.

    Args:
        errors: errors in left-out places.
        seed: of initialisation and batches.
        on_step: called with the number of steps done.
        steps: number of steps; None for the default.
    """
    steps = _STEPS if steps is None else steps
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = UncertaintyNet(errors.tokens.shape[1], min(COMPONENTS, errors.tokens.shape[1]))
        tokens = errors.tokens.float()
        network.centre.copy_(tokens.mean(dim=0))
        variance, axes = torch.linalg.eigh(torch.cov(tokens.T))
        largest = torch.arange(len(variance) - 1, len(variance) - 1 - len(network.basis), -1)
        network.basis.copy_((axes[:, largest] / variance[largest].clamp_min(1e-6).sqrt()).T)
        network.offset.copy_(errors.features.mean(dim=0))
        network.gain.copy_(1 / errors.features.std(dim=0).clamp_min(1e-4))
        inputs = network_inputs(network, errors)
        target = errors.share * errors.error.mean()
        places = [torch.nonzero(errors.place == place)[:, 0] for place in _distinct(errors.place)]
        optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
        for step in range(steps):
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / steps)
            some = torch.cat([of[torch.randint(len(of), (_BATCH // len(places),))] for of in places])
            spread = network.log_spread(inputs[some])
            loss = (target[some] * (-spread).exp() + spread).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
            on_step(step + 1)
    return network.eval().requires_grad_(False)


def network_inputs(network: UncertaintyNet, errors: Errors) -> Tensor:
    """Inputs ``(N, components + FEATURES)`` of ``network`` at each pixel."""
    components = (errors.tokens.float() - network.centre) @ network.basis.T
    return torch.cat([components, network.standardised(errors.features)], dim=1)


def spread_of(network: UncertaintyNet, errors: Errors) -> Tensor:
    """Log spread ``(N,)`` of each pixel by a head combined with ``network``."""
    return mean_log_spread(errors.own, network.log_spread(network_inputs(network, errors)))


def sigma_scale(network: UncertaintyNet, errors: Errors) -> float:
    """The factor on sigma with which 68 % of the errors after median scaling lie within one sigma.

    It is the mean over places, so each place counts the same.
    """
    ratio = errors.error / (math.sqrt(2.0) * spread_of(network, errors).exp())
    places = [ratio[errors.place == place] for place in _distinct(errors.place)]
    return float(np.mean([np.quantile(of_place.numpy(), _ONE_SIGMA) for of_place in places]))


def surest_half(uncertainty: Tensor, errors: Errors) -> float:
    """Mean error of the more certain half of the pixels over that of all pixels; mean over views.

    Args:
        uncertainty: ``(N,)``, larger means less certain; only its order within a view matters.
        errors: errors at the same pixels.
    """
    found = []
    for view in _distinct(errors.view):
        mine = errors.view == view
        error, of_view = torch.expm1(errors.error[mine]), uncertainty[mine]
        found.append(float(error[of_view <= of_view.median()].mean() / error.mean().clamp_min(1e-9)))
    return float(np.mean(found))


def of_places(errors: Errors, chosen: Tensor) -> Errors:
    """The pixels where ``chosen (N,)`` is true."""
    return Errors(*(getattr(errors, name)[chosen] for name in _FIELDS))


def learn_uncertainty(
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
    folds: Sequence[Fold],
    train: Callable[[int, tuple[Ints, ...]], DepthHead],
    *,
    seed: int,
    device: str,
    progress: Progress,
) -> tuple[UncertaintyNet, float, dict[str, dict[str, float]]]:
    """Train the head of each fold, collect its errors in left-out places, and fit the uncertainty.

    Args:
        planned, caches: all caches of the training.
        folds: the splits of their samples.
        train: trains the head of a fold, given its number and the samples of each cache.
        seed: of the fits and of the chosen pixels.
        device: where the heads compute.
        progress: called with the progress of each stage.

    Returns:
        The fitted network; the factor on its sigma; and :func:`surest_half` of each place by three
        measures: ``out_of_fold``, the uncertainty fitted without that place; ``own``, that of the
        head alone; ``depth_contrast``, the distance of a pixel's log depth from the view's median.

    Raises:
        DatasetError: no view has enough known depth.
    """
    parts = []
    names: list[str] = []
    numbers = []  # of each cache's places
    for plan in planned:
        names += [place.name for place in plan.places if place.name not in names]
        numbers.append([names.index(place.name) for place in plan.places])
    for number, fold in enumerate(folds):
        head = train(number, fold.training).eval()
        for k, views in enumerate(fold.left_out):
            if (part := errors_of(head, caches[k], views, numbers[k], [seed, number, k], device)) is not None:
                parts.append(part)
        progress(TrainStep("errors in left-out places", number + 1, len(folds)))
    if not parts:
        raise DatasetError("no view has enough known depth to fit an uncertainty to")
    errors = join(parts)
    network = fit_uncertainty(errors, seed, lambda step: progress(TrainStep("uncertainty", step, _STEPS)))
    unseen: dict[str, dict[str, float]] = {}
    places = _distinct(errors.place)
    for place in places:
        mine = errors.place == place
        without, there = fit_uncertainty(of_places(errors, ~mine), seed), of_places(errors, mine)
        unseen[names[place]] = {
            "out_of_fold": surest_half(spread_of(without, there), there),
            "own": surest_half(there.own, there),
            "depth_contrast": surest_half(there.features[:, 1], there),
        }
        logger.info("surest half in %s, not trained on: %s", names[place], unseen[names[place]])
        progress(TrainStep("uncertainty without a place", len(unseen), len(places)))
    return network, sigma_scale(network, errors), unseen


def _distinct(numbers: Tensor) -> list[int]:
    """The distinct values of ``numbers (N,)``, ascending."""
    return [int(number) for number in np.unique(numbers.numpy())]
