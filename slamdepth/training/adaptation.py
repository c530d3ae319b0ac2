# SPDX-License-Identifier: Apache-2.0
"""Training of low-rank changes of the backbone's last blocks, together with heads that were trained before.

The frozen tokens limit what a head can tell of places unlike its training. Trained to the end, though, the
changes learn the training places by heart. The result therefore lies between the heads at the start and the
mean of several trainings, heads and changes alike (Wortsman et al., Robust fine-tuning of zero-shot models,
CVPR 2022, and Model soups, ICML 2022).
"""

from __future__ import annotations

import copy
import hashlib
import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from slamdepth.depth.adapters import Adapters, blended
from slamdepth.depth.dinov2 import DinoV2, from_grid
from slamdepth.depth.head import DepthHead, HeadEnsemble, HeadShape, load_head
from slamdepth.errors import ConfigError
from slamdepth.training.caches import PlannedCache
from slamdepth.training.checkpoint import checkpoint_path
from slamdepth.training.config import AdapterConfig, digest
from slamdepth.training.epochs import run_epochs
from slamdepth.training.features import FeatureCache, load_mixed_batch
from slamdepth.training.losses import supervised, total_loss
from slamdepth.training.member import MemberTraining, learning_rate, steps_per_epoch
from slamdepth.training.progress import TrainStep
from slamdepth.training.results import EpochFigures
from slamdepth.training.stages import Batch, hide_gravity, predict

logger = logging.getLogger(__name__)


def start_path(config: AdapterConfig) -> Path:
    """The file of the heads that the training starts from, with ``~`` expanded."""
    return Path(config.start).expanduser()


def new_adapters(config: AdapterConfig, backbone: DinoV2) -> Adapters:
    """Untrained changes of ``backbone``."""
    return Adapters(backbone.dim, len(backbone.blocks) - config.first, config.rank)


def heads_to_adapt(config: AdapterConfig, expected: HeadShape) -> HeadEnsemble:
    """The heads that the training starts from.

    Raises:
        ConfigError: their shape is not the ``expected`` one, or they have adapters already.
        WeightsError: their file cannot be read.
    """
    start, _ = load_head(start_path(config))
    if start.adapters is not None:
        raise ConfigError(f"setting 'adapters.start': {config.start} has adapters already")
    own, other = (
        replace(shape, uncertainty_dim=0, subspace_dim=0, gravity_dim=0) for shape in (start.shape, expected)
    )  # what is kept, and need not be trained
    if own != other:
        raise ConfigError(
            f"setting 'head': describes other heads than those of 'adapters.start', {config.start}: "
            f"{expected} and {start.shape}"
        )
    return start


def adapted_held_out(
    planned: Sequence[PlannedCache], heads: HeadEnsemble, backbone: DinoV2
) -> tuple[list[PlannedCache], DinoV2]:
    """Caches of the tokens that the adapted backbone gives in held-out places; and that backbone, a copy."""
    assert heads.adapters is not None
    adapted = copy.deepcopy(backbone)
    heads.adapters.merge_into(adapted)
    hashed = hashlib.sha256()
    for change in heads.adapters.state_dict().values():
        hashed.update(change.cpu().numpy().tobytes())
    held_out = [plan for plan in planned if plan.held_out is not None]
    folders = [
        plan.folder.with_name(digest(plan.view, plan.folder.name, hashed.hexdigest())) for plan in held_out
    ]
    return [replace(plan, folder=folder) for plan, folder in zip(held_out, folders, strict=True)], adapted


def adapt(
    start: HeadEnsemble, training: MemberTraining, backbone: DinoV2, caches: Sequence[FeatureCache]
) -> tuple[HeadEnsemble, list[EpochFigures]]:
    """Train all runs and blend them with ``start``.

    Args:
        start: heads, which stay as they are.
        training: the settings; ``training.config.adapters`` is given.
        backbone: frozen; it stays as it is.
        caches: training samples, with the tokens that enter the first changed block.

    Returns:
        The heads with adapters, and the figures of each epoch of each run. Gravity and uncertainty are those
        of ``start``; the uncertainty of the scale is left out, because it was fitted to other tokens.

    Raises:
        OutputError: a checkpoint cannot be written.
    """
    config = training.config.adapters
    assert config is not None
    members, changes, history = [], [], []
    for run in range(config.runs):
        heads, adapters, epochs = _train_run(start, training, backbone, caches, run)
        members.append(heads.state_dict())
        changes.append(adapters)
        history += epochs
    shape = replace(
        start.shape,
        subspace_dim=0,
        adapted_blocks=len(backbone.blocks) - config.first,
        adapter_rank=config.rank * config.runs,
    )
    result = HeadEnsemble(shape, start.sigma_scale)
    result.load_state_dict(start.state_dict(), strict=False)
    own, share = start.members.state_dict(), config.share
    mean = {name: torch.stack([run[name] for run in members]).mean(dim=0) for name in own}
    result.members.load_state_dict({
        name: (1 - share) * value + share * mean[name] for name, value in own.items()
    })  # fmt: skip
    assert result.adapters is not None
    result.adapters.load_state_dict(blended(changes, share).state_dict())
    return result, history


def _train_run(
    start: HeadEnsemble,
    training: MemberTraining,
    backbone: DinoV2,
    caches: Sequence[FeatureCache],
    run: int,
) -> tuple[nn.ModuleList, Adapters, list[EpochFigures]]:
    """Heads and changes after the training number ``run``, from its checkpoint if there is one."""
    config, device = training.config, training.device
    own = config.adapters
    assert own is not None
    seed = config.seed * 1000 + run
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        heads = nn.ModuleList(DepthHead(start.shape, config.head.dropout) for _ in start.members)
        heads.load_state_dict(start.members.state_dict())
        adapters = new_adapters(own, backbone)
        heads.to(device).train()
        adapters.to(device)
        optimiser = torch.optim.AdamW([
            {"params": heads.parameters(), "lr": config.learning_rate, "weight_decay": config.weight_decay},
            {"params": adapters.parameters(), "lr": own.learning_rate, "weight_decay": own.weight_decay},
        ])  # fmt: skip

        def one(epoch: int) -> EpochFigures:
            begin = time.perf_counter()
            loss = _run_epoch(training, backbone, caches, heads, adapters, optimiser, epoch, run)
            logger.info("run %d epoch %d: loss %.4f", run, epoch, loss)
            return EpochFigures(run, epoch, False, loss, None, None, time.perf_counter() - begin)

        history = run_epochs(
            one,
            config.coarse_epochs,
            {"heads": heads, "adapters": adapters, "optimiser": optimiser},
            checkpoint_path(config, run),
            training.key,
            device,
            seed,
        )
    return heads.eval().cpu(), adapters.cpu(), history


def _run_epoch(
    training: MemberTraining,
    backbone: DinoV2,
    caches: Sequence[FeatureCache],
    heads: nn.ModuleList,
    adapters: Adapters,
    optimiser: torch.optim.Optimizer,
    epoch: int,
    run: int,
) -> float:
    """Train ``heads`` and ``adapters`` in place for one epoch; returns the mean loss."""
    config = training.config
    peaks = [float(group.setdefault("peak", group["lr"])) for group in optimiser.param_groups]
    samples = np.array([(c, k) for c, cache in enumerate(caches) for k in range(len(cache))])
    order = np.random.default_rng([config.seed, run, epoch]).permutation(len(samples))
    steps = steps_per_epoch(config, len(samples))
    total = 0.0
    with adapters.beside(backbone):
        for step in range(steps):
            chosen = samples[np.sort(order[step * config.batch : (step + 1) * config.batch])]
            batch, supervision = load_mixed_batch(caches, chosen, training.device)
            loss = step_loss(training, backbone, heads, batch, supervision)
            share = learning_rate(config, epoch + step / steps) / config.learning_rate
            for group, peak in zip(optimiser.param_groups, peaks, strict=True):
                group["lr"] = peak * share
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            for module in (*heads, adapters):
                nn.utils.clip_grad_norm_(module.parameters(), 1.0)
            optimiser.step()
            total += float(loss.detach())
            done, epochs = epoch * steps + step + 1, config.coarse_epochs
            detail = f"epoch {epoch + 1} of {epochs}, loss {total / (step + 1):.4f}"
            stage = f"adapters {run + 1} of {config.adapters.runs}" if config.adapters else "adapters"
            training.progress(TrainStep(stage, done, steps * epochs, detail))
    return total / steps


def step_loss(
    training: MemberTraining, backbone: DinoV2, heads: nn.ModuleList, batch: Batch, supervision: Tensor
) -> Tensor:
    """Mean loss of the heads on the tokens of the adapted backbone.

    Args:
        batch: with the tokens that enter the first changed block as the last ones.
        supervision: ``(B, 2)`` of 0 and 1: shape, scale.
    """
    config = training.config
    assert config.adapters is not None
    whole = _through_last_blocks(batch, backbone, config.head.taps, config.adapters.first)
    losses = []
    for head in heads:
        assert isinstance(head, DepthHead)
        prediction, target = predict(head, hide_gravity(whole, config.head), is_fine=False)
        losses.append(total_loss(supervised(prediction, target, supervision), target, config.loss))
    return torch.stack(losses).mean()


def _through_last_blocks(batch: Batch, backbone: DinoV2, taps: Sequence[int], first: int) -> Batch:
    """``batch`` with the tokens of all ``taps``, of which those before block ``first`` are in it."""
    tokens, class_tokens, image, field, depth = batch
    entering = from_grid(tokens[:, -1], class_tokens[:, -1]).to(backbone.cls_token.dtype)
    cells = tokens.shape[-2], tokens.shape[-1]
    _, late = backbone.run(entering, range(first, taps[-1] + 1), taps, cells)
    grids, classes = (torch.stack(maps, dim=1) for maps in zip(*late, strict=True))
    return (
        torch.cat([tokens[:, :-1], grids.float()], dim=1),
        torch.cat([class_tokens[:, :-1], classes.float()], dim=1),
        image,
        field,
        depth,
    )
