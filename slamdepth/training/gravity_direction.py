# SPDX-License-Identifier: Apache-2.0
"""Learning which way is down: views whose gravity is known, and directions that are not it."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from slamdepth.depth.gravity_direction import GravityScorer, token_fields
from slamdepth.depth.head import HeadShape
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX
from slamdepth.errors import ConfigError
from slamdepth.training.features import FeatureCache
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.typing import Floats

logger = logging.getLogger(__name__)

STEPS = 2000
BATCH = 16
_RATE = 2e-3
_DECAY = 0.1
_DROPOUT = 0.4
_OFF = ((0.05, 2), (0.12, 4), (0.3, 5))  # deviation of directions about gravity, and how many
_RIGHT_RAD = 0.1  # deviation of what is taken for right


def offered_directions(down: Floats, rng: np.random.Generator) -> Floats:
    """Directions ``(22, 3)``: gravity itself, slightly off, up, horizontal ones as lines would offer them,
    some near gravity and some anywhere."""
    across = np.cross(down, rng.normal(size=3))
    across /= np.linalg.norm(across)
    along = np.cross(down, across)
    angles = rng.uniform(0, 2 * np.pi, 5)[:, None]
    level = np.cos(angles) * across + np.sin(angles) * along
    frame = np.stack([level[0], np.cross(down, level[0])])
    off = np.concatenate([down + rng.normal(0, deviation, (count, 3)) for deviation, count in _OFF])
    out = np.concatenate([
        down[None], off[:1], -down[None], frame, -frame, off[1:], level[1:4], rng.normal(size=(2, 3))
    ])  # fmt: skip
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def learn_down(
    caches: Sequence[FeatureCache], shape: HeadShape, seed: int, device: str, progress: Progress
) -> GravityScorer:
    """A scorer that tells gravity from other directions in the views of ``caches``.

    Raises:
        ConfigError: gravity is known of too few views.
    """
    known = [np.flatnonzero(np.linalg.norm(cache.down, axis=1) > 0.5) for cache in caches]
    pool = np.array([(c, k) for c, views in enumerate(known) for k in views])
    if len(pool) < BATCH:
        raise ConfigError("setting 'head.down_dim': gravity is known of too few views to learn it from")
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
            loss.backward()
            nn.utils.clip_grad_norm_(scorer.parameters(), 1.0)
            optimiser.step()
            progress(TrainStep("which way is down", step + 1, STEPS, f"loss {float(loss.detach()):.3f}"))
    logger.info("which way is down: learnt from %d views", len(pool))
    return scorer.eval()


def new_scorer(shape: HeadShape, device: str) -> GravityScorer:
    """One that has learnt nothing."""
    return GravityScorer(len(shape.taps) * shape.token_dim, shape.gravity_dim, _DROPOUT).to(device).train()


def loss_of(
    scorer: GravityScorer,
    caches: Sequence[FeatureCache],
    chosen: NDArray[np.int64],
    rng: np.random.Generator,
    device: str,
) -> torch.Tensor:
    """Cross entropy of the scores and of how near to gravity each direction is, in the samples
    ``chosen (B, 2)``, each a cache and a sample of it."""
    tokens, fields, angles = [], [], []
    for c, k in chosen:
        cache = caches[c]
        rows, columns = cache.canonical_m.shape[1:]
        down = np.asarray(cache.down[k], dtype=np.float64)
        offered = offered_directions(down, rng)
        focal_px = float(cache.focal_factor[k]) * CANONICAL_FOCAL_PX
        tokens.append(torch.from_numpy(np.asarray(cache.tokens[k])))
        fields.append(token_fields(torch.from_numpy(offered).float(), focal_px, rows, columns))
        angles.append(np.arccos(np.clip(offered @ down, -1.0, 1.0)))
    scores = scorer(torch.stack(tokens).to(device).float(), torch.stack(fields).to(device))
    right = torch.from_numpy(np.stack(angles)).float().to(device)
    right = torch.softmax(-(right**2) / (2 * _RIGHT_RAD**2), dim=1)
    return -(right * torch.log_softmax(scores, dim=1)).sum(dim=1).mean()
