# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a head on held-out views, and sample predictions for the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from slamdepth.depth.head import DepthHead, HeadEnsemble
from slamdepth.training.caches import PlannedCache
from slamdepth.training.config import LossConfig
from slamdepth.training.features import FeatureCache, load_batch
from slamdepth.training.losses import total_loss
from slamdepth.training.results import SampleView
from slamdepth.training.stages import predict
from slamdepth.typing import Floats

_BATCH = 10
_MIN_PIXELS = 100


def judge(ensemble: HeadEnsemble, cache: FeatureCache, device: str) -> tuple[dict[str, float], Floats]:
    """Depth figures over the samples of ``cache``, and ``|log error| / sigma`` of all their pixels.

    The figures are AbsRel as predicted and after median scaling per view, delta1 after that, the
    standard deviation of the views' log scales, and the share of errors below one sigma. They are
    empty if no view has enough known depth.
    """
    rows: list[list[float]] = []
    ratios = []
    for k in range(len(cache)):
        batch = load_batch(cache, np.array([k]), device)
        with torch.inference_mode():
            log_depth, sigma, _ = ensemble(*batch[:4])
        known = batch[4][0] > 0
        if int(known.sum()) < _MIN_PIXELS:
            continue
        error = (log_depth[0][known] - batch[4][0][known].log()).double().cpu().numpy()
        ratios.append(np.abs(error) / sigma[0][known].double().cpu().numpy())
        median = float(np.median(error))
        scaled = np.exp(error - median)
        rows.append([
            float(np.mean(np.abs(np.exp(error) - 1))),
            float(np.mean(np.abs(scaled - 1))),
            float(np.mean(np.maximum(scaled, 1 / scaled) < 1.25)),
            median,
        ])  # fmt: skip
    if not rows:
        return {}, np.ones(1)
    table = np.array(rows)
    ratio = np.concatenate(ratios)
    return {
        "abs_rel": float(table[:, 0].mean()),
        "abs_rel_frame_median": float(table[:, 1].mean()),
        "delta1_frame_median": float(table[:, 2].mean()),
        "scale_spread": float(table[:, 3].std()),
        "within_one_sigma": float(np.mean(ratio < 1)),
    }, ratio


def held_out_figures(
    head: DepthHead, caches: Sequence[FeatureCache], config: LossConfig, is_fine: bool, device: str
) -> tuple[float, float]:
    """Loss and AbsRel after median scaling per view of one member, at the resolution of its stage.

    Both are means over the views of a place, then over places.
    """
    was_training = head.training
    head.eval()
    losses, errors = [], []
    with torch.inference_mode():
        for cache in caches:
            place_losses, place_errors = [], []
            for start in range(0, len(cache), _BATCH):
                chosen = np.arange(start, min(start + _BATCH, len(cache)))
                prediction, target = predict(head, load_batch(cache, chosen, device), is_fine)
                place_losses.append(len(chosen) * float(total_loss(prediction, target, config)))
                for log_depth, depth in zip(prediction[:, 0], target, strict=True):
                    known = depth > 0
                    if bool(known.any()):
                        error = log_depth[known] - depth[known].log()
                        place_errors.append(float(((error - error.median()).exp() - 1).abs().mean()))
            losses.append(sum(place_losses) / len(cache))
            errors.append(float(np.mean(place_errors)) if place_errors else np.nan)
    head.train(was_training)
    return float(np.mean(losses)), float(np.nanmean(errors)) if np.isfinite(errors).any() else np.nan


def sample_views(
    ensemble: HeadEnsemble, planned: Sequence[PlannedCache], caches: Sequence[FeatureCache], count: int,
    device: str,
) -> tuple[SampleView, ...]:  # fmt: skip
    """At most ``count`` views with their prediction, from as many different places as possible.

    A third is from training places, or all if nothing is held out.
    """
    both = list(zip(planned, caches, strict=True))
    held_out = [(p, c) for p, c in both if p.held_out is not None]
    trained = [(p, c) for p, c in both if p.held_out is None]
    chosen = _spread(held_out, count - count // 3 if trained else count)
    chosen += _spread(trained, count - len(chosen))
    return tuple(_sample_view(ensemble, p, c, k, device) for p, c, k in chosen)


def _spread(
    sources: list[tuple[PlannedCache, FeatureCache]], count: int
) -> list[tuple[PlannedCache, FeatureCache, int]]:
    """Samples of each place in turn, evenly spaced within a place."""
    by_place = [
        (planned, cache, np.flatnonzero(cache.place == place))
        for planned, cache in sources
        for place in range(len(planned.places))
    ]
    by_place = [entry for entry in by_place if len(entry[2])]
    if not by_place:
        return []
    rounds = -(-count // len(by_place))
    picks = []
    for turn in range(rounds):
        for planned, cache, samples in by_place:
            if turn < len(samples):
                k = samples[(2 * turn + 1) * len(samples) // (2 * min(rounds, len(samples)))]
                picks.append((planned, cache, int(k)))
    return picks[:count]


def _sample_view(
    ensemble: HeadEnsemble, planned: PlannedCache, cache: FeatureCache, k: int, device: str
) -> SampleView:
    batch = load_batch(cache, np.array([k]), device)
    with torch.inference_mode():
        log_depth, sigma, _ = ensemble(*batch[:4])
    factor = float(cache.focal_factor[k])
    return SampleView(
        planned.places[int(cache.place[k])].name,
        planned.held_out is not None,
        np.array(cache.image_rgb[k]),
        np.asarray(cache.canonical_m[k], dtype=np.float32) * np.float32(factor),
        (log_depth[0].exp() * factor).float().cpu().numpy(),
        sigma[0].float().cpu().numpy(),
    )
