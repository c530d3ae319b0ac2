# SPDX-License-Identifier: Apache-2.0
"""What a training would take, told before it is begun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from slamdepth.depth.checkpoints import check_device
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import DepthHead, HeadShape
from slamdepth.depth.head_layers import FACTOR, GRAVITY_CHANNELS
from slamdepth.depth.preprocess import PATCH
from slamdepth.errors import WeightsError
from slamdepth.training.caches import Encoder, benchmarks_seen, of_member, open_encoder, plan_caches
from slamdepth.training.config import TrainConfig
from slamdepth.training.data import PlaceReader
from slamdepth.training.features import encode, sample_specs
from slamdepth.training.loop import head_shape, steps_per_epoch
from slamdepth.training.losses import total_loss
from slamdepth.training.out_of_fold import plan_folds
from slamdepth.training.output import check_output
from slamdepth.training.stages import predict
from slamdepth.training.store import bytes_per_sample, done_on_disk
from slamdepth.training.timing import doubt_s, down_s, second_time


@dataclass(frozen=True)
class PlannedSource:
    """One line of a plan.

    Attributes:
        places: names of its places.
        images: images with depth in them.
        samples, cached: views that are needed, and those of them on the disk already.
        size_bytes: of all its views on the disk.
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
    """What a training would take.

    Attributes:
        steps: of the heads.
        features_s, training_s: wall time, from a view and a step of each stage measured just now, with
            what finds out which way is down and what learns uncertainty; None where the backbone is
            missing.
        missing: why it could not be measured.
        benchmarks: benchmarks the head will have seen, each with the places of it.
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
    """Open the places of ``config``, count, and measure one batch of each kind; nothing is written.

    Args:
        backbone: use this instead of the weights ``config`` names (for tests).

    Raises:
        ConfigError, DatasetError: as :func:`~slamdepth.training.caches.plan_caches`.
        OutputError: as :func:`~slamdepth.training.output.check_output`.
    """
    check_device(device)
    check_output(config)
    encoder, missing = None, None
    try:
        encoder = Encoder(backbone) if backbone is not None else open_encoder(config.backbone, device)
    except WeightsError as error:
        missing = str(error)
    backbone = encoder.backbone if encoder else None
    planned = plan_caches(config, encoder.key if encoder else "missing", readers)
    dim, patch = (backbone.dim, backbone.patch) if backbone else (HeadShape().token_dim, PATCH)
    specs = sample_specs(config.view, config.head.taps, dim, patch)
    sources = tuple(
        PlannedSource(
            tuple(place.name for place in plan.places),
            plan.held_out is not None,
            sum(map(len, plan.places)),
            len(plan.keys),
            done_on_disk(plan.folder, len(plan.keys), specs),
            len(plan.keys) * bytes_per_sample(specs),
            plan.folder,
        )
        for plan in planned
    )
    steps = sum(
        steps_per_epoch(config, sum(len(plan.keys) for plan in of_member(planned, planned, member)))
        for member in range(config.members)
    )
    folds = plan_folds(planned) if config.uncertainty == "out_of_fold" else []
    fold_steps = config.coarse_epochs * sum(
        steps_per_epoch(config, sum(map(len, fold.learnt))) for fold in folds
    )
    features_s = training_s = None
    if backbone is not None:
        todo = sum(source.samples - source.cached for source in sources)
        features_s = todo * _view_s(config, backbone, device) if todo else 0.0
        coarse_s, fine_s = _step_s(config, dim, patch, device)
        epoch_s = config.coarse_epochs * coarse_s + config.fine_epochs * fine_s
        training_s = steps * epoch_s + fold_steps * coarse_s
        training_s += down_s(config, dim, patch, device) if config.head.down_dim else 0.0
        training_s += doubt_s(planned, folds, dim) if folds else 0.0
    total = steps * (config.coarse_epochs + config.fine_epochs) + fold_steps
    return TrainingPlan(sources, total, features_s, training_s, missing, benchmarks_seen(planned))


def _view_s(config: TrainConfig, backbone: DinoV2, device: str) -> float:
    images = [np.zeros((config.view.rows, config.view.columns, 3), np.uint8)] * 4
    return second_time(lambda: encode(images, backbone, config.head.taps, device)) / len(images)


def _step_s(config: TrainConfig, dim: int, patch: int, device: str) -> tuple[float, float]:
    view, taps = config.view, config.head.taps
    cells = view.rows // FACTOR, view.columns // FACTOR
    head = DepthHead(head_shape(config, dim), config.head.dropout).to(device).train()
    batch = (
        torch.zeros(config.batch, len(taps), dim, view.rows // patch, view.columns // patch, device=device),
        torch.zeros(config.batch, len(taps), dim, device=device),
        torch.zeros(config.batch, 3, view.rows, view.columns, device=device),
        torch.zeros(config.batch, GRAVITY_CHANNELS, *cells, device=device),
        torch.ones(config.batch, view.rows, view.columns, device=device),
    )

    def step(is_fine: bool) -> None:
        loss = total_loss(*predict(head, batch, is_fine), config.loss)
        loss.backward()
        float(loss.detach())  # waits for a GPU

    return second_time(lambda: step(False)), second_time(lambda: step(True))
