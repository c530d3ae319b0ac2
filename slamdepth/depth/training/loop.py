# SPDX-License-Identifier: Apache-2.0
"""Training of a depth head on cached features.

First epochs at 1/7 resolution, where a step costs a fifth, then a few at full resolution
for the edges. After every epoch a checkpoint is written; a killed training goes on from
it to the same result, bit for bit.
"""

from __future__ import annotations

import json
import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.head import DepthHead, HeadEnsemble, HeadShape, save_head
from slamdepth.depth.training.caches import judging_cache, training_cache
from slamdepth.depth.training.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from slamdepth.depth.training.config import TrainConfig, digest
from slamdepth.depth.training.features import FeatureCache, Progress, load_batch
from slamdepth.depth.training.judge import judge
from slamdepth.depth.training.losses import total_loss
from slamdepth.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)

COARSE = 7
_ONE_SIGMA = 0.6827


@dataclass(frozen=True)
class TrainResult:
    """What a training made.

    Attributes:
        output: the head file.
        losses: ``(members, epochs)`` mean training loss.
        held_out: for each held-out place, the figures of :func:`judge`.
        sigma_scale: factor on sigma stored in the head.
    """

    output: Path
    losses: NDArray[np.float64]
    held_out: dict[str, dict[str, float]]
    sigma_scale: float


def train_depth(
    config: TrainConfig,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    backbone: DinoV2 | None = None,
) -> TrainResult:
    """Train the heads of ``config``, judge them on its held-out places, write the file.

    Args:
        backbone: use this instead of the weights ``config`` names (for tests).

    Raises:
        ConfigError: a place is both trained on and held out.
        DatasetError: a place is missing or malformed.
        WeightsError: the backbone is missing or damaged.
        OutputError: the output cannot be written.
    """
    tell = progress or (lambda what, share: None)
    trained = {(s.folder, place.name) for s in config.sources for place in s.places}
    both = trained & {(s.folder, name) for s in config.sources for name in s.held_out}
    if both:
        raise ConfigError(f"setting 'sources': {min(both)[1]} is held out and also trained on")
    if not trained:
        raise ConfigError("setting 'sources': there is no place to train on")
    output = Path(config.output)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output.parent}: cannot be made: {error.strerror}") from error
    backbone_sha256 = "given"
    if backbone is None:
        file = store.find_backbone(config.backbone)
        backbone_sha256 = store.verify(file)
        backbone = load_dinov2(file, device)

    taps = config.head.taps
    caches = [
        cache
        for source in config.sources
        if (cache := training_cache(source, config, backbone, backbone_sha256, device, progress)) is not None
    ]
    shape = HeadShape(
        taps, backbone.dim, config.head.dim, config.head.blocks, config.head.guide_dim, config.members
    )
    ensemble = HeadEnsemble(shape)
    losses = []
    for member in range(config.members):
        head, history = _train_member(config, caches, shape, member, device, tell)
        ensemble.members[member].load_state_dict(head.state_dict())
        losses.append(history)
    ensemble.eval().to(device)

    held_out, ratios = {}, []
    for source in config.sources:
        for name in source.held_out:
            plain = judging_cache(source, name, config, backbone, backbone_sha256, device, progress)
            held_out[name], ratio = judge(ensemble, plain, device)
            ratios.append(ratio)
    ensemble.sigma_scale = config.sigma_scale
    if ratios:
        # Each place counts the same: the mean over places of the ratio that covers 68 %.
        ensemble.sigma_scale = float(np.mean([np.quantile(ratio, _ONE_SIGMA) for ratio in ratios]))
    names = ", ".join(place.name for source in config.sources for place in source.places)
    about = {
        "trained_on": config.trained_on or names,
        "licence": config.licence,
        "seed": str(config.seed),
        "settings": json.dumps(config.model_dump(mode="json"), sort_keys=True),
        "backbone_sha256": backbone_sha256,
    }
    try:
        save_head(output, ensemble, about)
        for member in range(config.members):
            checkpoint_path(config, member).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error.strerror}") from error
    return TrainResult(output, np.array(losses), held_out, ensemble.sigma_scale)


def _train_member(
    config: TrainConfig,
    caches: list[FeatureCache],
    shape: HeadShape,
    member: int,
    device: str,
    tell: Progress,
) -> tuple[DepthHead, list[float]]:
    seed = config.seed * 1000 + member
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = DepthHead(shape, config.head.dropout).to(device)
        optimiser = torch.optim.AdamW(
            head.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        path, key = checkpoint_path(config, member), digest(config, member)
        history: list[float] = []
        if (state := load_checkpoint(path, key, device)) is not None:
            head.load_state_dict(state["head"])
            optimiser.load_state_dict(state["optimiser"])
            history = list(state["history"])
            logger.info("going on from epoch %d of %s", len(history), path)
        epochs = config.coarse_epochs + config.fine_epochs
        for epoch in range(len(history), epochs):
            torch.manual_seed(seed + 1_000_003 * (epoch + 1))  # so that a resumed epoch drops the same
            history.append(_epoch(config, caches, head, optimiser, epoch, seed, device))
            save_checkpoint(
                path,
                {"key": key, "head": head.state_dict(), "optimiser": optimiser.state_dict(),
                 "history": history},
            )  # fmt: skip
            logger.info("member %d epoch %d: loss %.4f", member, epoch, history[-1])
            tell(f"member {member + 1}: loss {history[-1]:.4f}", (epoch + 1) / epochs)
    return head.eval(), history


def _epoch(
    config: TrainConfig,
    caches: list[FeatureCache],
    head: DepthHead,
    optimiser: torch.optim.Optimizer,
    epoch: int,
    seed: int,
    device: str,
) -> float:
    head.train()
    samples = np.array([(c, k) for c, cache in enumerate(caches) for k in range(len(cache))])
    order = np.random.default_rng([seed, epoch]).permutation(len(samples))
    steps = max(1, len(samples) // config.batch)
    is_fine = epoch >= config.coarse_epochs
    total = 0.0
    for step in range(steps):
        chosen = samples[np.sort(order[step * config.batch : (step + 1) * config.batch])]
        parts = [
            load_batch(cache, chosen[chosen[:, 0] == c, 1], device)
            for c, cache in enumerate(caches)
            if (chosen[:, 0] == c).any()
        ]
        tokens, class_tokens, image, target = (torch.cat(part) for part in zip(*parts, strict=True))
        if is_fine:
            prediction = head(tokens, class_tokens, image)
        else:
            prediction = head.coarse(tokens, class_tokens, image)[0]
            target = coarse_target(target)
        loss = total_loss(prediction, target, config.loss)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(config, epoch + step / steps)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        total += float(loss.detach())
    return total / steps


def learning_rate(config: TrainConfig, epoch: float) -> float:
    """The rate ``epoch`` (with its fraction) into a training: a warm-up, then half a cosine
    to nothing over the coarse epochs, and another from a tenth over the fine ones."""
    if epoch < config.coarse_epochs:
        share = epoch / config.coarse_epochs
        return config.learning_rate * min(1.0, 0.04 + share / 0.08) * 0.5 * (1 + math.cos(math.pi * share))
    share = (epoch - config.coarse_epochs) / max(1, config.fine_epochs)
    return 0.1 * config.learning_rate * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


def coarse_target(target: Tensor) -> Tensor:
    """Median of the known depths of each 7 x 7 block of ``(B, H, W)``; 0 where there are none."""
    batch, rows, columns = target.shape
    blocks = target.reshape(batch, rows // COARSE, COARSE, columns // COARSE, COARSE)
    blocks = blocks.permute(0, 1, 3, 2, 4).flatten(3)
    known = torch.where(blocks > 0, blocks, torch.nan)
    return known.nanmedian(dim=-1).values.nan_to_num(0.0)
