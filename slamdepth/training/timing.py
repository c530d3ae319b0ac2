# SPDX-License-Identifier: Apache-2.0
"""How long the parts of a training take, by doing a little of each on made-up data."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from slamdepth.depth.uncertainty import FEATURES
from slamdepth.training import gravity_direction as down
from slamdepth.training.caches import PlannedCache
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.training.loop import head_shape
from slamdepth.training.out_of_fold import PIXELS, Errors, Fold, fit_doubt

_MADE_UP_PIXELS = 20_000


def down_s(config: TrainConfig, dim: int, patch: int, device: str) -> float:
    """Seconds of learning which way is down, by one of its steps, from tokens of ``dim`` channels."""
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
    scorer, rng = down.new_scorer(head_shape(config, dim), device), np.random.default_rng(0)
    chosen = np.zeros((down.BATCH, 2), np.int64)

    def step() -> None:
        loss = down.loss_of(scorer, [cache], chosen, rng, device)
        loss.backward()
        float(loss.detach())  # waits for a GPU

    return down.STEPS * second_time(step)


def doubt_s(planned: Sequence[PlannedCache], folds: Sequence[Fold], dim: int) -> float:
    """Seconds of all fits of an uncertainty, of all places and without each, by one of few pixels.

    What a fit does before its steps takes as long as there are pixels; its steps do not depend on them.
    """
    both = ((plan, views) for fold in folds for plan, views in zip(planned, fold.left_out, strict=True))
    left_out = [(plan, k) for plan, views in both for k in views]
    places = {plan.places[plan.keys[k].place].name for plan, k in left_out}
    errors = _made_up(_MADE_UP_PIXELS, len(places), dim)
    before_s = second_time(lambda: fit_doubt(errors, 0, steps=0))
    steps_s = max(0.0, second_time(lambda: fit_doubt(errors, 0)) - before_s)
    return (1 + len(places)) * (before_s * len(left_out) * PIXELS / _MADE_UP_PIXELS + steps_s)


def second_time(work: Callable[[], object]) -> float:
    """Seconds of the second call: the first one pays for memory and plans."""
    work()
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _made_up(pixels: int, places: int, dim: int) -> Errors:
    make = torch.Generator().manual_seed(0)
    ones, numbers = torch.ones(pixels), torch.arange(pixels)
    tokens, read = (torch.randn(pixels, channels, generator=make) for channels in (dim, FEATURES))
    return Errors(tokens.half(), read, ones, ones, 0 * ones, numbers % places, numbers)
