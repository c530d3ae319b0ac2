# SPDX-License-Identifier: Apache-2.0
"""Backbone features of augmented views, computed once and kept on disk.

The backbone is frozen, so a view's tokens never change; what a training costs is this
cache. It grows by a few samples at a time and continues where a killed run stopped.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX, normalised
from slamdepth.depth.training.augment import View, augmented_view, plain_view
from slamdepth.depth.training.config import ViewConfig
from slamdepth.depth.training.data import Place
from slamdepth.depth.training.progress import Progress, TrainStep, silent
from slamdepth.depth.training.store import SampleStore, Spec, locked

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from slamdepth.depth.dinov2 import DinoV2

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampleKey:
    """Which view of which pair a sample is; copy -1 is the plain, unaugmented view."""

    place: int
    frame: int
    copy: int


@dataclass(frozen=True)
class FeatureCache:
    """Samples on disk, memory-mapped.

    Attributes:
        tokens: ``(N, taps, dim, rows/14, columns/14)`` float16.
        class_tokens: ``(N, taps, dim)`` float16.
        image_rgb: ``(N, rows, columns, 3)`` uint8.
        canonical_m: ``(N, rows, columns)`` float16, depth at the canonical focal
            length, 0 unknown.
        focal_factor: ``(N,)`` float32; metres per canonical metre.
        place: ``(N,)`` int, index into the places.
    """

    tokens: NDArray[np.float16]
    class_tokens: NDArray[np.float16]
    image_rgb: NDArray[np.uint8]
    canonical_m: NDArray[np.float16]
    focal_factor: NDArray[np.float32]
    place: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.place)


def plan_samples(places: Sequence[Place], samples: Sequence[int], seed: int) -> list[SampleKey]:
    """Which views to make: each place's number spread over its frames, in random order.

    A place with more frames than samples is thinned evenly; one with fewer is shown
    several times, each copy augmented anew.
    """
    keys = []
    for index, (place, count) in enumerate(zip(places, samples, strict=True)):
        frames = len(place)
        if count < frames:
            chosen = np.linspace(0, frames - 1, count).round().astype(int)
            keys += [SampleKey(index, int(frame), 0) for frame in chosen]
        else:
            keys += [SampleKey(index, k % frames, k // frames) for k in range(count)]
    order = np.random.default_rng(seed).permutation(len(keys))
    return [keys[k] for k in order]


def plan_plain(place_index: int, place: Place, limit: int) -> list[SampleKey]:
    """At most ``limit`` unaugmented views of one place, spread over it; for judging."""
    count = min(limit, len(place))
    chosen = np.linspace(0, len(place) - 1, count).round().astype(int)
    return [SampleKey(place_index, int(frame), -1) for frame in chosen]


def sample_specs(config: ViewConfig, taps: tuple[int, ...], dim: int, patch: int) -> dict[str, Spec]:
    """Shape and type of each array of one sample, for a backbone of ``dim`` channels."""
    rows, columns = config.rows, config.columns
    return {
        "tokens": ((len(taps), dim, rows // patch, columns // patch), np.float16),
        "class_tokens": ((len(taps), dim), np.float16),
        "image_rgb": ((rows, columns, 3), np.uint8),
        "canonical_m": ((rows, columns), np.float16),
        "focal_factor": ((), np.float32),
    }


def build_cache(
    folder: Path,
    places: Sequence[Place],
    keys: Sequence[SampleKey],
    config: ViewConfig,
    backbone: DinoV2,
    taps: tuple[int, ...],
    seed: int,
    *,
    device: str = "cpu",
    batch: int = 4,
    progress: Progress = silent,
    stage: str = "features",
) -> FeatureCache:
    """Fill (or finish filling) the cache in ``folder`` and open it.

    Raises:
        DatasetError: an image or its depth cannot be read.
        OutputError: the folder cannot be written or the disk is too small.
    """
    with locked(folder):
        store = SampleStore(folder, len(keys), sample_specs(config, taps, backbone.dim, backbone.patch))
        groups = store.groups_to_do(batch)
        if groups:
            logger.info("computing %d of %d samples into %s", sum(map(len, groups)), len(keys), folder)
        for count, group in enumerate(groups, start=1):
            views = [make_view(places, keys[k], config, seed) for k in group]
            tokens, class_tokens = encode([view.image_rgb for view in views], backbone, taps, device)
            factors = [view.focal_px / CANONICAL_FOCAL_PX for view in views]
            store.put(
                group,
                tokens=tokens,
                class_tokens=class_tokens,
                image_rgb=np.stack([view.image_rgb for view in views]),
                canonical_m=np.stack([_canonical(v, f, config) for v, f in zip(views, factors, strict=True)]),
                focal_factor=factors,
            )
            progress(TrainStep(stage, count, len(groups)))
        store.commit()
    arrays = store.arrays
    place = np.array([key.place for key in keys], dtype=np.int64)
    return FeatureCache(
        arrays["tokens"], arrays["class_tokens"], arrays["image_rgb"], arrays["canonical_m"],
        np.asarray(arrays["focal_factor"]), place,
    )  # fmt: skip


def _canonical(view: View, factor: float, config: ViewConfig) -> NDArray[np.float32]:
    known = (view.depth_m >= config.min_depth_m) & (view.depth_m <= config.max_depth_m)
    return np.where(known, view.depth_m / np.float32(factor), 0.0).astype(np.float32)


def make_view(places: Sequence[Place], key: SampleKey, config: ViewConfig, seed: int) -> View:
    """The view ``key`` names; the same for the same seed whatever else is made."""
    place = places[key.place]
    frame = place.read(key.frame)
    if key.copy < 0:
        return plain_view(frame, config.rows, config.columns)
    rng = np.random.default_rng([seed, zlib.crc32(place.name.encode()), key.frame, key.copy])
    return augmented_view(frame, config.rows, config.columns, config.augment, rng)


def encode(
    images_rgb: list[NDArray[np.uint8]], backbone: DinoV2, taps: tuple[int, ...], device: str
) -> tuple[NDArray[np.float16], NDArray[np.float16]]:
    """Tokens ``(B, taps, dim, h, w)`` and class tokens ``(B, taps, dim)`` of images of one size."""
    import torch

    with torch.inference_mode():
        tapped = backbone(normalised(np.stack(images_rgb), device), taps)
        tokens = torch.stack([grid for grid, _ in tapped], dim=1)
        class_tokens = torch.stack([token for _, token in tapped], dim=1)
    return tokens.half().cpu().numpy(), class_tokens.half().cpu().numpy()


def load_batch(
    cache: FeatureCache, chosen: NDArray[np.int64], device: str
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Tokens, class tokens, normalised images and canonical depth of the samples ``chosen (B,)``."""
    import torch

    return (
        torch.from_numpy(cache.tokens[chosen]).to(device).float(),
        torch.from_numpy(cache.class_tokens[chosen]).to(device).float(),
        normalised(cache.image_rgb[chosen], device),
        torch.from_numpy(cache.canonical_m[chosen]).to(device).float(),
    )
