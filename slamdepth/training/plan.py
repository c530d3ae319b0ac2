# SPDX-License-Identifier: Apache-2.0
"""The cost of a training, estimated before it starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from slamdepth.depth.checkpoints import check_device
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import DepthHead, HeadShape
from slamdepth.depth.head_layers import FACTOR, GRAVITY_CHANNELS
from slamdepth.depth.preprocess import PATCH
from slamdepth.errors import WeightsError
from slamdepth.training.adaptation import new_adapters, step_loss
from slamdepth.training.caches import (
    Encoder,
    PlannedCache,
    benchmarks_seen,
    of_member,
    open_encoder,
    plan_caches,
    tapped_by,
)
from slamdepth.training.config import TrainConfig
from slamdepth.training.data import PlaceReader
from slamdepth.training.features import encode, sample_specs
from slamdepth.training.losses import total_loss
from slamdepth.training.member import MemberTraining, head_shape, steps_per_epoch
from slamdepth.training.out_of_fold import Fold, plan_folds
from slamdepth.training.output import check_output
from slamdepth.training.progress import silent
from slamdepth.training.stages import Batch, predict
from slamdepth.training.store import Spec, bytes_per_sample, done_on_disk
from slamdepth.training.timing import gravity_s, second_time, step_s, uncertainty_s


@dataclass(frozen=True)
class PlannedSource:
    """One source of a plan.

    Attributes:
        places: names of its places.
        images: number of images with depth.
        samples, cached: number of views needed, and of those already on disk.
        size_bytes: size of all its views on disk.
        folder: its feature cache.
    """

    places: tuple[str, ...]
    is_held_out: bool
    images: int
    samples: int
    cached: int
    size_bytes: int
    folder: Path


@dataclass(frozen=True)
class TrainingPlan:
    """The cost of a training.

    Attributes:
        sources: its feature caches.
        steps: optimisation steps of all heads.
        features_s, training_s: wall time, estimated from a view and a step of each stage; includes the
            gravity network and the uncertainty. None if the backbone is missing.
        missing: why the time could not be measured, else None.
        benchmarks: benchmarks that the head will have seen, each with its places.
    """

    sources: tuple[PlannedSource, ...]
    steps: int
    features_s: float | None
    training_s: float | None
    missing: str | None
    benchmarks: dict[str, tuple[str, ...]]


def plan_training(
    config: TrainConfig,
    *,
    device: str = "cpu",
    backbone: DinoV2 | None = None,
    readers: Mapping[str, PlaceReader] | None = None,
) -> TrainingPlan:
    """Open the places of ``config``, count samples, and time one batch of each kind; writes nothing.

    Args:
        device: where to compute, such as "cpu" or "cuda".
        backbone: use this instead of the weights named in ``config`` (for tests).
        readers: further readers of places, in addition to those of :mod:`slamdepth.training.readers`.

    Raises:
        ConfigError: see :func:`~slamdepth.training.caches.plan_caches`, or the device does not exist.
        DatasetError: a place is missing or malformed.
        OutputError: see :func:`~slamdepth.training.output.check_output`.
    """
    check_device(device)
    check_output(config)
    encoder, missing = None, None
    try:
        encoder = Encoder(backbone) if backbone is not None else open_encoder(config.backbone, device)
    except WeightsError as error:
        missing = str(error)
    planned = plan_caches(config, encoder.key if encoder else "missing", readers)
    dim = encoder.backbone.dim if encoder else HeadShape().token_dim
    patch = encoder.backbone.patch if encoder else PATCH
    sources = tuple(
        _planned_source(plan, sample_specs(config.view, plan.tapped, dim, patch)) for plan in planned
    )
    folds = plan_folds(planned) if config.uncertainty == "out_of_fold" else []
    steps, fold_steps = _member_steps(config, planned), _fold_steps(config, folds)
    features_s = training_s = None
    if encoder is not None:
        todo = sum(source.samples - source.cached for source in sources)
        features_s = todo * _view_s(config, encoder.backbone, device) if todo else 0.0
        if config.adapters is not None:
            training_s = steps * config.coarse_epochs * _adapter_step_s(config, encoder.backbone, device)
        else:
            coarse_s, fine_s = _step_s(config, dim, patch, device)
            epoch_s = config.coarse_epochs * coarse_s + config.fine_epochs * fine_s
            training_s = steps * epoch_s + fold_steps * coarse_s
            training_s += gravity_s(config, dim, patch, device) if config.head.gravity_dim else 0.0
            training_s += uncertainty_s(planned, folds, dim) if folds else 0.0
    total = steps * (config.coarse_epochs + config.fine_epochs) + fold_steps
    return TrainingPlan(sources, total, features_s, training_s, missing, benchmarks_seen(planned))


def _member_steps(config: TrainConfig, planned: Sequence[PlannedCache]) -> int:
    """Steps of all members, or of all trainings of adapters, in one epoch."""
    if config.adapters is not None:
        samples = sum(len(plan.keys) for plan in planned if plan.trains_depth)
        return config.adapters.runs * steps_per_epoch(config, samples)
    return sum(
        steps_per_epoch(config, sum(len(plan.keys) for plan in of_member(planned, planned, member)))
        for member in range(config.members)
    )


def _fold_steps(config: TrainConfig, folds: Sequence[Fold]) -> int:
    """Steps of the heads of all folds, in all of their epochs."""
    return config.coarse_epochs * sum(steps_per_epoch(config, sum(map(len, fold.training))) for fold in folds)


def _planned_source(plan: PlannedCache, specs: Mapping[str, Spec]) -> PlannedSource:
    return PlannedSource(
        tuple(place.name for place in plan.places),
        plan.held_out is not None,
        sum(map(len, plan.places)),
        len(plan.keys),
        done_on_disk(plan.folder, len(plan.keys), specs),
        len(plan.keys) * bytes_per_sample(specs),
        plan.folder,
    )


def _view_s(config: TrainConfig, backbone: DinoV2, device: str) -> float:
    images = [np.zeros((config.view.rows, config.view.columns, 3), np.uint8)] * 4
    return second_time(lambda: encode(images, backbone, tapped_by(config), device)) / len(images)


def _blank_batch(config: TrainConfig, maps: int, dim: int, patch: int, device: str) -> Batch:
    view = config.view
    cells = view.rows // FACTOR, view.columns // FACTOR
    return (
        torch.zeros(config.batch, maps, dim, view.rows // patch, view.columns // patch, device=device),
        torch.zeros(config.batch, maps, dim, device=device),
        torch.zeros(config.batch, 3, view.rows, view.columns, device=device),
        torch.zeros(config.batch, GRAVITY_CHANNELS, *cells, device=device),
        torch.ones(config.batch, view.rows, view.columns, device=device),
    )


def _adapter_step_s(config: TrainConfig, backbone: DinoV2, device: str) -> float:
    own = config.adapters
    assert own is not None
    shape = head_shape(config, backbone.dim)
    heads = nn.ModuleList(DepthHead(shape, config.head.dropout) for _ in range(config.members)).to(device)
    training = MemberTraining(config, shape, "", device, silent)
    batch = _blank_batch(config, tapped_by(config).count, backbone.dim, backbone.patch, device)
    supervision = torch.ones(config.batch, 2, device=device)
    with new_adapters(own, backbone).to(device).beside(backbone):
        return step_s(lambda: step_loss(training, backbone, heads, batch, supervision))


def _step_s(config: TrainConfig, dim: int, patch: int, device: str) -> tuple[float, float]:
    head = DepthHead(head_shape(config, dim), config.head.dropout).to(device).train()
    batch = _blank_batch(config, len(config.head.taps), dim, patch, device)

    def loss_of(is_fine: bool) -> torch.Tensor:
        return total_loss(*predict(head, batch, is_fine), config.loss)

    return step_s(lambda: loss_of(False)), step_s(lambda: loss_of(True))
