# SPDX-License-Identifier: Apache-2.0
"""Training of one head of an ensemble on cached features, with a checkpoint after every epoch.

The first epochs use the loss at 1/7 resolution, where a step costs a fifth. A few epochs at full
resolution follow, which train the upsampling only. A killed training resumes from its last checkpoint
and gives the same result, bit for bit.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from slamdepth.depth.head import UPSAMPLING, DepthHead, HeadShape
from slamdepth.training.checkpoint import checkpoint_path
from slamdepth.training.config import TrainConfig
from slamdepth.training.epochs import run_epochs
from slamdepth.training.features import FeatureCache, load_mixed_batch
from slamdepth.training.judge import held_out_figures
from slamdepth.training.losses import supervised, total_loss
from slamdepth.training.progress import Progress, TrainStep
from slamdepth.training.results import EpochFigures
from slamdepth.training.stages import FINE_COST, hide_gravity, predict
from slamdepth.typing import Ints

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MemberTraining:
    """What all heads of one training have in common.

    Attributes:
        config: the settings.
        shape: the shape of each head.
        key: identifies settings and data; a checkpoint with another key is not used.
        device: where the heads are trained.
        progress: called after each step.
        held_out: caches to evaluate on after each epoch.
    """

    config: TrainConfig
    shape: HeadShape
    key: str
    device: str
    progress: Progress
    held_out: tuple[FeatureCache, ...] = ()


def head_shape(config: TrainConfig, token_dim: int, *, uncertainty: int = 0) -> HeadShape:
    """The shape of the heads of ``config``.

    Args:
        token_dim: channels of the backbone's tokens.
        uncertainty: token components read by the fitted uncertainty; 0 for none.
    """
    return HeadShape(
        config.head.taps,
        token_dim,
        config.head.dim,
        config.head.blocks,
        config.head.guide_dim,
        members=config.members,
        uncertainty_dim=uncertainty,
        scale_dim=config.head.scale_dim,
        input_px=config.view.rows * config.view.columns,
        gravity=config.head.gravity,
        gravity_dim=config.head.gravity_dim,
    )


def train_member(
    training: MemberTraining, caches: Sequence[FeatureCache], views: Sequence[Ints], member: int
) -> tuple[DepthHead, list[EpochFigures]]:
    """Train the head number ``member``, from its checkpoint if there is one.

    Args:
        training: what it shares with the other heads.
        caches: its training samples.
        views: ``(n,)`` for each cache, the samples to use.
        member: its number; it seeds the training and names the checkpoint.

    Returns:
        The head in eval mode, and the figures of each epoch.

    Raises:
        OutputError: a checkpoint cannot be written.
    """
    config, device = training.config, training.device
    seed = _seed(config, member)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = DepthHead(training.shape, config.head.dropout).to(device)
        optimiser = torch.optim.AdamW(
            head.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )

        def one(epoch: int) -> EpochFigures:
            start = time.perf_counter()
            loss = run_epoch(training, caches, views, head, optimiser, epoch, member)
            seconds = time.perf_counter() - start
            is_fine = epoch >= config.coarse_epochs
            figures: tuple[float | None, float | None] = (None, None)
            if training.held_out:
                figures = held_out_figures(head, training.held_out, config.loss, is_fine, device)
            logger.info("member %d epoch %d: loss %.4f, held out %s", member, epoch, loss, figures[0])
            return EpochFigures(member, epoch, is_fine, loss, figures[0], figures[1], seconds)

        history = run_epochs(
            one,
            config.coarse_epochs + config.fine_epochs,
            {"head": head, "optimiser": optimiser},
            checkpoint_path(config, member),
            training.key,
            device,
            seed,
        )
    return head.eval(), history


def run_epoch(
    training: MemberTraining,
    caches: Sequence[FeatureCache],
    views: Sequence[Ints],
    head: DepthHead,
    optimiser: torch.optim.Optimizer,
    epoch: int,
    member: int,
) -> float:
    """Train ``head`` in place for one epoch; returns its mean loss."""
    config = training.config
    head.train()
    is_fine = epoch >= config.coarse_epochs
    for name, parameter in head.named_parameters():  # training more at full resolution overfits to the places
        parameter.requires_grad_(not is_fine or name.startswith(UPSAMPLING))
    samples = np.array([(c, k) for c, of_cache in enumerate(views) for k in of_cache])
    order = np.random.default_rng([_seed(config, member), epoch]).permutation(len(samples))
    steps = steps_per_epoch(config, len(samples))
    total = 0.0
    for step in range(steps):
        chosen = samples[np.sort(order[step * config.batch : (step + 1) * config.batch])]
        batch, supervision = load_mixed_batch(caches, chosen, training.device)
        batch = hide_gravity(batch, config.head)
        prediction, target = predict(head, batch, is_fine)
        loss = total_loss(supervised(prediction, target, supervision), target, config.loss)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(config, epoch + step / steps)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        total += float(loss.detach())
        training.progress(_train_step(config, member, epoch, step + 1, steps, total / (step + 1)))
    return total / steps


def steps_per_epoch(config: TrainConfig, samples: int) -> int:
    """Whole batches in an epoch, at least one."""
    return max(1, samples // config.batch)


def learning_rate(config: TrainConfig, epoch: float) -> float:
    """The learning rate at ``epoch``, which may be fractional.

    A warm-up and half a cosine to zero over the coarse epochs, then another half cosine over the fine
    ones.
    """
    if epoch < config.coarse_epochs:
        share = epoch / config.coarse_epochs
        return config.learning_rate * min(1.0, 0.04 + share / 0.08) * 0.5 * (1 + math.cos(math.pi * share))
    share = (epoch - config.coarse_epochs) / max(1, config.fine_epochs)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


def _seed(config: TrainConfig, member: int) -> int:
    return config.seed * 1000 + member


def _train_step(
    config: TrainConfig, member: int, epoch: int, step: int, steps: int, loss: float
) -> TrainStep:
    """Progress of a member, in units of coarse steps."""
    coarse, fine = min(epoch, config.coarse_epochs), max(0, epoch - config.coarse_epochs)
    done = steps * (coarse + FINE_COST * fine) + step * (FINE_COST if epoch >= config.coarse_epochs else 1)
    total = steps * (config.coarse_epochs + FINE_COST * config.fine_epochs)
    epochs = config.coarse_epochs + config.fine_epochs
    detail = f"epoch {epoch + 1} of {epochs}, loss {loss:.4f}"
    fold = member - config.members  # numbers beyond the members are heads of folds
    stage = f"without places, {fold + 1}" if fold >= 0 else f"member {member + 1} of {config.members}"
    return TrainStep(stage, done, total, detail)
