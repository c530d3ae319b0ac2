# SPDX-License-Identifier: Apache-2.0
"""Duration of the parts of a training, measured on a few steps with synthetic data."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from slamdepth.depth.uncertainty import FEATURES
from slamdepth.training import gravity_direction
from slamdepth.training.caches import PlannedCache
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.training.member import head_shape
from slamdepth.training.out_of_fold import PIXELS, Errors, Fold, fit_uncertainty

_SYNTHETIC_PIXELS = 20_000


def gravity_s(config: TrainConfig, dim: int, patch: int, device: str) -> float:
    """Seconds of training the gravity network on tokens of ``dim`` channels, from one of its steps."""
    view, taps = config.view, len(config.head.taps)
    cache = FeatureCache(
        np.ones((1, taps, dim, view.rows // patch, view.columns // patch), np.float16),
        np.ones((1, taps, dim), np.float16),
        np.zeros((1, view.rows, view.columns, 3), np.uint8),
        np.ones((1, view.rows, view.columns), np.float16),
        np.ones(1, np.float32),
        np.array([[0.0, 1.0, 0.0]], np.float32),
        np.zeros(1, np.int64),
    )
    scorer, rng = gravity_direction.new_scorer(head_shape(config, dim), device), np.random.default_rng(0)
    chosen = np.zeros((gravity_direction.BATCH, 2), np.int64)

    return gravity_direction.STEPS * step_s(
        lambda: gravity_direction.loss_of(scorer, [cache], chosen, rng, device)
    )


def uncertainty_s(planned: Sequence[PlannedCache], folds: Sequence[Fold], dim: int) -> float:
    """Seconds of all fits of the uncertainty, one to all places and one without each place.

    The setup of a fit is proportional to the number of pixels; its steps do not depend on it. Both are
    measured on few pixels.
    """
    both = ((plan, views) for fold in folds for plan, views in zip(planned, fold.left_out, strict=True))
    left_out = [(plan, k) for plan, views in both for k in views]
    places = {plan.places[plan.keys[k].place].name for plan, k in left_out}
    errors = _synthetic_errors(_SYNTHETIC_PIXELS, len(places), dim)
    setup_s = second_time(lambda: fit_uncertainty(errors, 0, steps=0))
    steps_s = max(0.0, second_time(lambda: fit_uncertainty(errors, 0)) - setup_s)
    return (1 + len(places)) * (setup_s * len(left_out) * PIXELS / _SYNTHETIC_PIXELS + steps_s)


def step_s(loss_of: Callable[[], torch.Tensor]) -> float:
    """Seconds of a training step: a loss and its gradients."""

    def step() -> None:
        loss = loss_of()
        torch.autograd.backward(loss)
        float(loss.detach())  # synchronises with a GPU

    return second_time(step)


def second_time(work: Callable[[], object]) -> float:
    """Seconds of the second call of ``work``; the first one allocates memory and plans kernels."""
    work()
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _synthetic_errors(pixels: int, places: int, dim: int) -> Errors:
    make = torch.Generator().manual_seed(0)
    ones, numbers = torch.ones(pixels), torch.arange(pixels)
    tokens, read = (torch.randn(pixels, channels, generator=make) for channels in (dim, FEATURES))
    return Errors(tokens.half(), read, ones, ones, 0 * ones, numbers % places, numbers)
