# SPDX-License-Identifier: Apache-2.0
"""Training of a depth head on cached features.

First epochs at 1/7 resolution, where a step costs a fifth, then a few at full resolution
for the edges, which train the upsampling alone. After every epoch a checkpoint is written; a
killed training goes on from it to the same result, bit for bit.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from slamdepth.depth.checkpoints import check_device
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import FORMAT, UPSAMPLING, DepthHead, HeadEnsemble, HeadShape, save_head
from slamdepth.errors import OutputError
from slamdepth.training.caches import (
    Encoder,
    PlannedCache,
    benchmarks_seen,
    fill_cache,
    of_gravity,
    of_member,
    open_encoder,
    plan_caches,
)
from slamdepth.training.checkpoint import (
    checkpoint_path,
    load_checkpoint,
    remove_checkpoints,
    save_checkpoint,
    sync_file,
)
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.data import PlaceReader
from slamdepth.training.features import FeatureCache, load_mixed_batch
from slamdepth.training.gravity_direction import learn_down
from slamdepth.training.judge import held_out_figures, judge, sample_views
from slamdepth.training.known_depth import check_known_depth
from slamdepth.training.losses import taught, total_loss
from slamdepth.training.out_of_fold import COMPONENTS, learn_doubt, plan_folds
from slamdepth.training.output import check_output
from slamdepth.training.progress import Progress, TrainStep, silent
from slamdepth.training.results import EpochFigures, TrainResult
from slamdepth.training.stages import FINE_COST, not_always_told, predict

logger = logging.getLogger(__name__)

_ONE_SIGMA = 0.6827
_SAMPLES = 6


def train_depth(
    config: TrainConfig,
    *,
    device: str = "cpu",
    progress: Progress = silent,
    backbone: DinoV2 | None = None,
    readers: Mapping[str, PlaceReader] | None = None,
    on_result: Callable[[TrainResult], None] | None = None,
) -> TrainResult:
    """Train the heads of ``config``, judge them on its held-out places, write the file.

    Args:
        backbone: use this instead of the weights ``config`` names (for tests).
        readers: readers of places beside those of :mod:`slamdepth.training.readers`.
        on_result: called with the result while the checkpoints are still there, so that a
            training killed in it need not be done again.

    Raises:
        ConfigError: a place is both trained on and held out, the device is not there, or there
            are not two places to learn uncertainty from.
        DatasetError: a place is missing or malformed, or no view to learn from has known depth.
        WeightsError: the backbone is missing or damaged.
        OutputError: the output cannot be written, or is a file that is no head.
    """
    check_device(device)
    output = check_output(config)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output.parent}: cannot be made: {error.strerror}") from error
    encoder = Encoder(backbone) if backbone is not None else open_encoder(config.backbone, device)
    planned = plan_caches(config, encoder.key, readers)
    folds = plan_folds(planned) if config.uncertainty == "out_of_fold" else []
    seen = [f"{benchmark} ({', '.join(names)})" for benchmark, names in benchmarks_seen(planned).items()]
    for benchmark in seen:
        logger.warning("trained on %s: figures of this head on it are not zero-shot", benchmark)
    caches = [
        fill_cache(
            plan, config, encoder.backbone, device=device, progress=progress, stage=_stage(plan, k, planned)
        )
        for k, plan in enumerate(planned)
    ]
    check_known_depth(config, planned, caches, folds)
    judging = [cache for plan, cache in zip(planned, caches, strict=True) if plan.held_out is not None]
    dim = encoder.backbone.dim
    shape = head_shape(config, dim, uncertainty_dim=min(COMPONENTS, dim) if folds else 0)
    key = digest(config, FORMAT, [plan.folder.name for plan in planned])
    ensemble = HeadEnsemble(shape)
    history: list[EpochFigures] = []
    for member in range(config.members):
        training = of_member(planned, caches, member)
        views = [np.arange(len(cache)) for cache in training]
        head, epochs = _train_member(config, training, views, judging, shape, member, key, device, progress)
        ensemble.members[member].load_state_dict(head.state_dict())
        history += epochs
    if ensemble.gravity is not None:
        scorer = learn_down(of_gravity(planned, caches), shape, config.seed, device, progress)
        ensemble.gravity.load_state_dict(scorer.state_dict())
    unseen: dict[str, dict[str, float]] = {}
    ensemble.sigma_scale = config.sigma_scale
    if folds:

        def of_fold(number: int, learnt: tuple[NDArray[np.int64], ...]) -> DepthHead:
            alone, place = config.model_copy(update={"fine_epochs": 0}), config.members + number
            return _train_member(alone, caches, learnt, [], shape, place, key, device, progress)[0]

        doubt, ensemble.sigma_scale, unseen = learn_doubt(
            planned, caches, folds, of_fold, seed=config.seed, device=device, progress=progress
        )
        assert ensemble.uncertainty is not None
        ensemble.uncertainty.load_state_dict(doubt.state_dict())
    ensemble.eval().to(device)

    held_out, ratios = {}, []
    for plan, cache in zip(planned, caches, strict=True):
        if plan.held_out is not None:
            held_out[plan.held_out], ratio = judge(ensemble, cache, device)
            ratios.append(ratio)
    if ratios and not folds:
        # Each place counts the same: the mean over places of the ratio that covers 68 %.
        ensemble.sigma_scale = float(np.mean([np.quantile(ratio, _ONE_SIGMA) for ratio in ratios]))
    names = ", ".join(place.name for source in config.sources for place in source.places)
    about = {
        "trained_on": "; ".join([config.trained_on or names, *(f"has seen {b}" for b in seen)]),
        "licence": config.licence,
        "seed": str(config.seed),
        "settings": json.dumps(config.model_dump(mode="json"), sort_keys=True),
        "backbone_sha256": encoder.sha256,
    }
    result = TrainResult(
        output, tuple(history), held_out, ensemble.sigma_scale,
        sample_views(ensemble, planned, caches, _SAMPLES, device), _places(planned), about, unseen,
    )  # fmt: skip
    try:
        save_head(output, ensemble, about)
        sync_file(output)
        if on_result is not None:
            on_result(result)
        remove_checkpoints(config, config.members + len(folds))
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error.strerror}") from error
    return result


def head_shape(config: TrainConfig, token_dim: int, *, uncertainty_dim: int = 0) -> HeadShape:
    """The heads that ``config`` asks for, on tokens of ``token_dim`` channels."""
    return HeadShape(
        config.head.taps,
        token_dim,
        config.head.dim,
        config.head.blocks,
        config.head.guide_dim,
        members=config.members,
        uncertainty_dim=uncertainty_dim,
        scale_dim=config.head.level_dim,
        input_px=config.view.rows * config.view.columns,
        gravity=config.head.gravity,
        gravity_dim=config.head.down_dim,
    )


def _stage(plan: PlannedCache, index: int, planned: list[PlannedCache]) -> str:
    what = f"held-out {plan.held_out}" if plan.held_out else f"{len(plan.places)} places"
    return f"features {index + 1} of {len(planned)}, {what}"


def _places(planned: list[PlannedCache]) -> tuple[dict[str, object], ...]:
    return tuple(
        {
            "name": place.name,
            "is_held_out": plan.held_out is not None,
            "images": len(place),
            "samples": sum(key.place == index for key in plan.keys),
            "notes": list(place.notes),
        }
        for plan in planned
        for index, place in enumerate(plan.places)
    )


def _train_member(
    config: TrainConfig,
    caches: list[FeatureCache],
    views: Sequence[NDArray[np.int64]],
    judging: list[FeatureCache],
    shape: HeadShape,
    member: int,
    key: str,
    device: str,
    progress: Progress,
) -> tuple[DepthHead, list[EpochFigures]]:
    seed = _seed(config, member)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = DepthHead(shape, config.head.dropout).to(device)
        optimiser = torch.optim.AdamW(
            head.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        path = checkpoint_path(config, member)
        history: list[EpochFigures] = []
        if (state := load_checkpoint(path, key, device)) is not None:
            head.load_state_dict(state["head"])
            optimiser.load_state_dict(state["optimiser"])
            history = [EpochFigures(**figures) for figures in state["history"]]
            logger.info("going on from epoch %d of %s", len(history), path)
        for epoch in range(len(history), config.coarse_epochs + config.fine_epochs):
            torch.manual_seed(seed + 1_000_003 * (epoch + 1))  # so that a resumed epoch drops the same
            start = time.perf_counter()
            loss = _epoch(config, caches, views, head, optimiser, epoch, member, device, progress)
            seconds = time.perf_counter() - start
            is_fine = epoch >= config.coarse_epochs
            judged = (
                held_out_figures(head, judging, config.loss, is_fine, device) if judging else (None, None)
            )
            history.append(EpochFigures(member, epoch, is_fine, loss, judged[0], judged[1], seconds))
            save_checkpoint(
                path,
                key,
                {"head": head.state_dict(), "optimiser": optimiser.state_dict(),
                 "history": [asdict(figures) for figures in history]},
            )  # fmt: skip
            logger.info("member %d epoch %d: loss %.4f, held out %s", member, epoch, loss, judged[0])
    return head.eval(), history


def _epoch(
    config: TrainConfig,
    caches: list[FeatureCache],
    views: Sequence[NDArray[np.int64]],
    head: DepthHead,
    optimiser: torch.optim.Optimizer,
    epoch: int,
    member: int,
    device: str,
    progress: Progress,
) -> float:
    head.train()
    is_fine = epoch >= config.coarse_epochs
    for name, parameter in head.named_parameters():  # more at full resolution only learns places by heart
        parameter.requires_grad_(not is_fine or name.startswith(UPSAMPLING))
    samples = np.array([(c, k) for c, of_cache in enumerate(views) for k in of_cache])
    order = np.random.default_rng([_seed(config, member), epoch]).permutation(len(samples))
    steps = steps_per_epoch(config, len(samples))
    total = 0.0
    for step in range(steps):
        chosen = samples[np.sort(order[step * config.batch : (step + 1) * config.batch])]
        batch, teaches = load_mixed_batch(caches, chosen, device)
        batch = not_always_told(batch, config.head)
        prediction, target = predict(head, batch, is_fine)
        loss = total_loss(taught(prediction, target, teaches), target, config.loss)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(config, epoch + step / steps)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        total += float(loss.detach())
        progress(_how_far(config, member, epoch, step + 1, steps, total / (step + 1)))
    return total / steps


def _seed(config: TrainConfig, member: int) -> int:
    return config.seed * 1000 + member


def steps_per_epoch(config: TrainConfig, samples: int) -> int:
    """Whole batches in an epoch, at least one."""
    return max(1, samples // config.batch)


def _how_far(config: TrainConfig, member: int, epoch: int, step: int, steps: int, loss: float) -> TrainStep:
    """Progress of a member, in coarse steps."""
    coarse, fine = min(epoch, config.coarse_epochs), max(0, epoch - config.coarse_epochs)
    done = steps * (coarse + FINE_COST * fine) + step * (FINE_COST if epoch >= config.coarse_epochs else 1)
    total = steps * (config.coarse_epochs + FINE_COST * config.fine_epochs)
    epochs = config.coarse_epochs + config.fine_epochs
    detail = f"epoch {epoch + 1} of {epochs}, loss {loss:.4f}"
    left_out = member - config.members  # beyond the members are the heads without some places each
    what = f"without places, {left_out + 1}" if left_out >= 0 else f"member {member + 1} of {config.members}"
    return TrainStep(what, done, total, detail)


def learning_rate(config: TrainConfig, epoch: float) -> float:
    """The rate ``epoch`` (with its fraction) into a training: a warm-up, then half a cosine
    to nothing over the coarse epochs, and another over the fine ones."""
    if epoch < config.coarse_epochs:
        share = epoch / config.coarse_epochs
        return config.learning_rate * min(1.0, 0.04 + share / 0.08) * 0.5 * (1 + math.cos(math.pi * share))
    share = (epoch - config.coarse_epochs) / max(1, config.fine_epochs)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))
