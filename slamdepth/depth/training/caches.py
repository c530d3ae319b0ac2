# SPDX-License-Identifier: Apache-2.0
"""Which features a training needs, and the folders they are cached in."""

from __future__ import annotations

from pathlib import Path

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import DinoV2
from slamdepth.depth.training.config import SourceConfig, TrainConfig, digest
from slamdepth.depth.training.data import data_folder, open_place
from slamdepth.depth.training.features import (
    FeatureCache,
    Progress,
    build_cache,
    plan_plain,
    plan_samples,
)

_JUDGED_VIEWS = 50


def training_cache(
    source: SourceConfig,
    config: TrainConfig,
    backbone: DinoV2,
    backbone_sha256: str,
    device: str,
    progress: Progress | None,
) -> FeatureCache | None:
    if not source.places:
        return None
    folder = data_folder(source.folder)
    places = [open_place(folder / place.name) for place in source.places]
    samples = [place.samples for place in source.places]
    keys = plan_samples(places, samples, config.seed)[: source.limit]
    where = _cache_folder(config, backbone_sha256, source.places, source.limit, [len(p) for p in places])
    return build_cache(
        where, places, keys, config.view, backbone, config.head.taps, config.seed,
        device=device, progress=progress,
    )  # fmt: skip


def judging_cache(
    source: SourceConfig,
    name: str,
    config: TrainConfig,
    backbone: DinoV2,
    backbone_sha256: str,
    device: str,
    progress: Progress | None,
) -> FeatureCache:
    place = open_place(data_folder(source.folder) / name)
    where = _cache_folder(config, backbone_sha256, "plain", name, len(place))
    return build_cache(
        where, [place], plan_plain(0, place, _JUDGED_VIEWS), config.view, backbone, config.head.taps,
        config.seed, device=device, progress=progress,
    )  # fmt: skip


def _cache_folder(config: TrainConfig, *more: object) -> Path:
    return store.cache_dir() / "features" / digest(config.view, config.head.taps, config.seed, *more)
