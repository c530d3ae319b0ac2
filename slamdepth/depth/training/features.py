# SPDX-License-Identifier: Apache-2.0
"""Backbone features of augmented views, computed once and kept on disk.

The backbone is frozen, so a view's tokens never change; what a training costs is this
cache. It grows sample by sample and continues where a killed run stopped.
"""

from __future__ import annotations

import json
import logging
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX, normalised
from slamdepth.depth.training.augment import View, augmented_view, plain_view
from slamdepth.depth.training.config import ViewConfig
from slamdepth.depth.training.data import Place

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from slamdepth.depth.dinov2 import DinoV2

logger = logging.getLogger(__name__)

Progress = Callable[[str, float], None]


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


def plan_samples(places: list[Place], samples: list[int], seed: int) -> list[SampleKey]:
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


def build_cache(
    folder: Path,
    places: list[Place],
    keys: list[SampleKey],
    config: ViewConfig,
    backbone: DinoV2,
    taps: tuple[int, ...],
    seed: int,
    *,
    device: str = "cpu",
    batch: int = 4,
    progress: Progress | None = None,
) -> FeatureCache:
    """Fill (or finish filling) the cache in ``folder`` and open it."""
    tell = progress or (lambda what, share: None)
    arrays = _open_arrays(folder, len(keys), config, backbone, taps)
    done = arrays["done"]
    todo = [k for k in range(len(keys)) if not done[k]]
    if todo:
        logger.info("computing %d of %d samples into %s", len(todo), len(keys), folder)
    for start in range(0, len(todo), batch):
        chosen = todo[start : start + batch]
        views = [make_view(places, keys[k], config, seed) for k in chosen]
        tokens, class_tokens = encode([view.image_rgb for view in views], backbone, taps, device)
        for row, k in enumerate(chosen):
            view = views[row]
            factor = view.focal_px / CANONICAL_FOCAL_PX
            known = (view.depth_m >= config.min_depth_m) & (view.depth_m <= config.max_depth_m)
            arrays["tokens"][k] = tokens[row]
            arrays["class_tokens"][k] = class_tokens[row]
            arrays["image_rgb"][k] = view.image_rgb
            arrays["canonical_m"][k] = np.where(known, view.depth_m / factor, 0.0)
            arrays["focal_factor"][k] = factor
            done[k] = 1
        tell("computing features", (start + len(chosen)) / len(todo))
    place = np.array([key.place for key in keys], dtype=np.int64)
    return FeatureCache(
        arrays["tokens"], arrays["class_tokens"], arrays["image_rgb"], arrays["canonical_m"],
        np.asarray(arrays["focal_factor"]), place,
    )  # fmt: skip


def make_view(places: list[Place], key: SampleKey, config: ViewConfig, seed: int) -> View:
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


def _open_arrays(
    folder: Path, count: int, config: ViewConfig, backbone: DinoV2, taps: tuple[int, ...]
) -> dict[str, Any]:
    folder.mkdir(parents=True, exist_ok=True)
    rows, columns = config.rows, config.columns
    h, w = rows // backbone.patch, columns // backbone.patch
    shapes: dict[str, tuple[tuple[int, ...], type]] = {
        "tokens": ((count, len(taps), backbone.dim, h, w), np.float16),
        "class_tokens": ((count, len(taps), backbone.dim), np.float16),
        "image_rgb": ((count, rows, columns, 3), np.uint8),
        "canonical_m": ((count, rows, columns), np.float16),
        "focal_factor": ((count,), np.float32),
        "done": ((count,), np.uint8),
    }
    note = folder / "shapes.json"
    text = json.dumps({name: list(shape) for name, (shape, _) in shapes.items()})
    fresh = not note.is_file() or note.read_text(encoding="utf-8") != text
    arrays = {
        name: np.lib.format.open_memmap(
            folder / f"{name}.npy", mode="w+" if fresh else "r+", dtype=dtype, shape=shape if fresh else None
        )
        for name, (shape, dtype) in shapes.items()
    }
    if fresh:
        note.write_text(text, encoding="utf-8")
    return arrays
