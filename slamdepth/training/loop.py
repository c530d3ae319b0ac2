# SPDX-License-Identifier: Apache-2.0
"""Training of a depth head: cache the features, train the members, evaluate, write the file."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamdepth.depth.checkpoints import check_device
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.head import FORMAT, DepthHead, HeadEnsemble, save_head
from slamdepth.errors import OutputError
from slamdepth.io import sha256_of
from slamdepth.training.adaptation import adapt, adapted_held_out, heads_to_adapt, start_path
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
from slamdepth.training.checkpoint import remove_checkpoints, sync_file
from slamdepth.training.config import TrainConfig, digest
from slamdepth.training.data import PlaceReader
from slamdepth.training.features import FeatureCache
from slamdepth.training.gravity_direction import learn_gravity
from slamdepth.training.judge import judge, sample_views
from slamdepth.training.known_depth import check_known_depth
from slamdepth.training.member import MemberTraining, head_shape, train_member
from slamdepth.training.out_of_fold import COMPONENTS, Fold, learn_uncertainty, plan_folds
from slamdepth.training.output import check_output
from slamdepth.training.progress import Progress, silent
from slamdepth.training.results import EpochFigures, TrainResult
from slamdepth.typing import Floats, Ints

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
    """Train the heads of ``config``, evaluate them on its held-out places, write the file.

    Args:
        device: where to compute, such as "cpu" or "cuda".
        progress: called with the progress of each stage.
        backbone: use this instead of the weights named in ``config`` (for tests).
        readers: further readers of places, in addition to those of :mod:`slamdepth.training.readers`.
        on_result: called with the result before the checkpoints are removed, so that a training
            killed during the call need not be repeated.

    Raises:
        ConfigError: a place is both trained on and held out, the device does not exist, or there
            are fewer than two places to fit uncertainty on.
        DatasetError: a place is missing or malformed, or no training view has known depth.
        WeightsError: the backbone is missing or damaged.
        OutputError: the output cannot be written, or is an existing file that is not a head.
    """
    check_device(device)
    output = check_output(config)
    _make_folder(output.parent)
    encoder = Encoder(backbone) if backbone is not None else open_encoder(config.backbone, device)
    planned = plan_caches(config, encoder.key, readers)
    folds = plan_folds(planned) if config.uncertainty == "out_of_fold" else []
    dim = encoder.backbone.dim
    shape = head_shape(config, dim, uncertainty=min(COMPONENTS, dim) if folds else 0)
    start = None if config.adapters is None else heads_to_adapt(config.adapters, shape)
    about = _about(config, planned, encoder)

    def fill(plans: Sequence[PlannedCache], backbone: DinoV2) -> list[FeatureCache]:
        return [
            fill_cache(plan, config, backbone, device=device, progress=progress, stage=_stage(plan, k, plans))
            for k, plan in enumerate(plans)
        ]

    # Adapted heads are judged on other tokens than they start from.
    read = planned if start is None else [plan for plan in planned if plan.held_out is None]
    caches = fill(read, encoder.backbone)
    check_known_depth(config, read, caches, folds)
    key = digest(config, FORMAT, [plan.folder.name for plan in planned], about.get("adapted_from", ""))
    held_out = tuple(cache for plan, cache in zip(read, caches, strict=True) if plan.held_out is not None)
    training = MemberTraining(config, shape, key, device, progress, held_out)

    unseen: dict[str, dict[str, float]] = {}
    if start is not None:
        ensemble, history = adapt(start, training, encoder.backbone, caches)
        judged, adapted = adapted_held_out(planned, ensemble, encoder.backbone)
        judged_caches = fill(judged, adapted)
    else:
        judged, judged_caches = planned, caches
        ensemble = HeadEnsemble(shape)
        ensemble.sigma_scale = config.sigma_scale
        history = _train_members(ensemble, training, planned, caches)
        if ensemble.gravity is not None:
            scorer = learn_gravity(of_gravity(planned, caches), shape, config.seed, device, progress)
            ensemble.gravity.load_state_dict(scorer.state_dict())
        unseen = _fit_uncertainty(ensemble, training, planned, caches, folds) if folds else {}
    ensemble.eval().to(device)

    figures, ratios = _judge_held_out(ensemble, judged, judged_caches, device)
    if ratios and not folds and start is None:
        # Each place counts the same: the mean over places of the ratio that covers 68 %.
        ensemble.sigma_scale = float(np.mean([np.quantile(ratio, _ONE_SIGMA) for ratio in ratios]))
    result = TrainResult(
        output,
        tuple(history),
        figures,
        ensemble.sigma_scale,
        sample_views(ensemble, judged, judged_caches, _SAMPLES, device),
        _places(planned),
        about,
        unseen,
    )
    try:
        save_head(output, ensemble, about)
        sync_file(output)
        if on_result is not None:
            on_result(result)
        remove_checkpoints(config, (config.adapters.runs if config.adapters else config.members) + len(folds))
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error.strerror}") from error
    return result


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error


def _about(config: TrainConfig, planned: Sequence[PlannedCache], encoder: Encoder) -> dict[str, str]:
    """The header of the head file; logs a warning for each benchmark among the training places."""
    seen = [f"{benchmark} ({', '.join(names)})" for benchmark, names in benchmarks_seen(planned).items()]
    for benchmark in seen:
        logger.warning("trained on %s: figures of this head on it are not zero-shot", benchmark)
    names = ", ".join(place.name for source in config.sources for place in source.places)
    return {
        "trained_on": "; ".join([config.trained_on or names, *(f"has seen {b}" for b in seen)]),
        "licence": config.licence,
        "seed": str(config.seed),
        "settings": json.dumps(config.model_dump(mode="json"), sort_keys=True),
        "backbone_sha256": encoder.sha256,
        **({} if config.adapters is None else {"adapted_from": sha256_of(start_path(config.adapters))}),
    }


def _train_members(
    ensemble: HeadEnsemble,
    training: MemberTraining,
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
) -> list[EpochFigures]:
    history: list[EpochFigures] = []
    for member in range(training.config.members):
        own = of_member(planned, caches, member)
        head, epochs = train_member(training, own, [np.arange(len(cache)) for cache in own], member)
        ensemble.members[member].load_state_dict(head.state_dict())
        history += epochs
    return history


def _fit_uncertainty(
    ensemble: HeadEnsemble,
    training: MemberTraining,
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
    folds: Sequence[Fold],
) -> dict[str, dict[str, float]]:
    """Fit the uncertainty of ``ensemble`` on errors in left-out places; figures by place."""
    config = training.config
    coarse = replace(training, config=config.model_copy(update={"fine_epochs": 0}), held_out=())

    def train_fold(number: int, samples: tuple[Ints, ...]) -> DepthHead:
        return train_member(coarse, caches, samples, config.members + number)[0]

    uncertainty, ensemble.sigma_scale, unseen = learn_uncertainty(
        planned,
        caches,
        folds,
        train_fold,
        seed=config.seed,
        device=training.device,
        progress=training.progress,
    )
    assert ensemble.uncertainty is not None
    ensemble.uncertainty.load_state_dict(uncertainty.state_dict())
    return unseen


def _judge_held_out(
    ensemble: HeadEnsemble, planned: Sequence[PlannedCache], caches: Sequence[FeatureCache], device: str
) -> tuple[dict[str, dict[str, float]], list[Floats]]:
    """Figures of each held-out place, and its ``|log error| / sigma``."""
    figures: dict[str, dict[str, float]] = {}
    ratios = []
    for plan, cache in zip(planned, caches, strict=True):
        if plan.held_out is not None:
            figures[plan.held_out], ratio = judge(ensemble, cache, device)
            ratios.append(ratio)
    return figures, ratios


def _stage(plan: PlannedCache, index: int, planned: Sequence[PlannedCache]) -> str:
    what = f"held-out {plan.held_out}" if plan.held_out else f"{len(plan.places)} places"
    return f"features {index + 1} of {len(planned)}, {what}"


def _places(planned: Sequence[PlannedCache]) -> tuple[dict[str, object], ...]:
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
