# SPDX-License-Identifier: Apache-2.0
"""Training of the gravity network: it scores candidate directions in views of known gravity."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from slamdepth.depth.gravity_direction import GravityScorer, token_fields
from slamdepth.depth.head import HeadShape
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.errors import ConfigError
from slamdepth.training.features import FeatureCache
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.typing import Floats, Ints

logger = logging.getLogger(__name__)

STEPS = 2000
BATCH = 16
_RATE = 2e-3
_DECAY = 0.1
_DROPOUT = 0.4
_NEARBY = ((0.05, 2), (0.12, 4), (0.3, 5))  # deviation from gravity and number of candidates
_TARGET_SIGMA_RAD = 0.1  # width of the target distribution about gravity


def candidate_directions(gravity: Floats, rng: np.random.Generator) -> Floats:
    """Unit candidates ``(22, 3)``, ``gravity (3,)`` first.

    They are gravity, a direction near it, its opposite, four horizontal ones as vanishing points give
    them, further ones near gravity, further horizontal ones, and two random ones.
    """
    across = np.cross(gravity, rng.normal(size=3))
    across /= np.linalg.norm(across)
    along = np.cross(gravity, across)
    angles = rng.uniform(0, 2 * np.pi, 5)[:, None]
    horizontal = np.cos(angles) * across + np.sin(angles) * along
    axes = np.stack([horizontal[0], np.cross(gravity, horizontal[0])])
    near = np.concatenate([gravity + rng.normal(0, deviation, (count, 3)) for deviation, count in _NEARBY])
    random = rng.normal(size=(2, 3))
    out = np.concatenate(
        [gravity[None], near[:1], -gravity[None], axes, -axes, near[1:], horizontal[1:4], random]
    )
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def learn_gravity(
    caches: Sequence[FeatureCache], shape: HeadShape, seed: int, device: str, progress: Progress
) -> GravityScorer:
    """Train the gravity network on the views of ``caches`` whose gravity is known.

    Raises:
        ConfigError: there are too few such views.
    """
    known = [np.flatnonzero(np.linalg.norm(cache.gravity, axis=1) > 0.5) for cache in caches]
    pool = np.array([(c, k) for c, views in enumerate(known) for k in views])
    if len(pool) < BATCH:
        raise ConfigError("setting 'head.gravity_dim': too few views of known gravity to train on")
    rng = np.random.default_rng([seed, 23])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        scorer = new_scorer(shape, device)
        optimiser = torch.optim.AdamW(scorer.parameters(), lr=_RATE, weight_decay=_DECAY)
        for step in range(STEPS):
            chosen = pool[np.sort(rng.choice(len(pool), BATCH, replace=False))]
            loss = loss_of(scorer, caches, chosen, rng, device)
            for group in optimiser.param_groups:
                group["lr"] = _RATE * (1 - step / STEPS) + 1e-5
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            nn.utils.clip_grad_norm_(scorer.parameters(), 1.0)
            optimiser.step()
            progress(TrainStep("gravity", step + 1, STEPS, f"loss {float(loss.detach()):.3f}"))
    logger.info("gravity network: trained on %d views", len(pool))
    return scorer.eval()


def new_scorer(shape: HeadShape, device: str) -> GravityScorer:
    """An untrained gravity network in training mode."""
    return GravityScorer(len(shape.taps) * shape.token_dim, shape.gravity_dim, _DROPOUT).to(device).train()


def loss_of(
    scorer: GravityScorer,
    caches: Sequence[FeatureCache],
    chosen: Ints,
    rng: np.random.Generator,
    device: str,
) -> torch.Tensor:
    """Cross entropy between the scores of candidates and a Gaussian of their angles to gravity.

    Args:
        chosen: ``(B, 2)``, cache and sample index of each view.
        rng: draws the candidates.
    """
    tokens, fields, angles = [], [], []
    for c, k in chosen:
        cache = caches[c]
        rows, columns = cache.canonical_m.shape[1:]
        gravity = np.asarray(cache.gravity[k], dtype=np.float64)
        candidates = candidate_directions(gravity, rng)
        focal_px = float(cache.focal_factor[k]) * CANONICAL_FOCAL_PX
        tokens.append(torch.from_numpy(np.asarray(cache.tokens[k])))
        fields.append(token_fields(torch.from_numpy(candidates).float(), focal_px, rows, columns))
        angles.append(np.arccos(np.clip(candidates @ gravity, -1.0, 1.0)))
    scores = scorer(torch.stack(tokens).to(device).float(), torch.stack(fields).to(device))
    angle = torch.from_numpy(np.stack(angles)).float().to(device)
    target = torch.softmax(-(angle**2) / (2 * _TARGET_SIGMA_RAD**2), dim=1)
    return -(target * torch.log_softmax(scores, dim=1)).sum(dim=1).mean()
