# SPDX-License-Identifier: Apache-2.0
"""Backbone features of augmented views, computed once and cached on disk.

The backbone is frozen, so the tokens of a view never change. Computing them is most of the cost of a
training. The cache grows by a few samples at a time and resumes where a killed run stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.gravity_field import gravity_field
from slamdepth.depth.preprocess import CANONICAL_FOCAL_PX, normalised
from slamdepth.training.config import Supervision, ViewConfig
from slamdepth.training.data import Place
from slamdepth.training.progress import Progress, TrainStep, silent
from slamdepth.training.store import SampleStore, Spec, locked
from slamdepth.training.views import Partner, SampleKey, canonical_depth, make_view
from slamdepth.typing import Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from slamdepth.depth.dinov2 import DinoV2

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tapped:
    """What of the backbone is cached.

    Attributes:
        taps: blocks whose tokens are read, ascending.
        entering: block whose input is kept too, after those and without the final norm, so that training can
            go on from there; None for none.
    """

    taps: tuple[int, ...]
    entering: int | None = None

    @property
    def count(self) -> int:
        """Number of token maps of a view."""
        return len(self.taps) + (self.entering is not None)


@dataclass(frozen=True)
class FeatureCache:
    """Samples on disk, memory-mapped.

    Attributes:
        tokens: ``(N, maps, dim, rows/14, columns/14)`` float16, see :class:`Tapped`.
        class_tokens: ``(N, maps, dim)`` float16.
        image_rgb: ``(N, rows, columns, 3)`` uint8.
        canonical_m: ``(N, rows, columns)`` float16, depth at the canonical focal
            length, 0 unknown.
        focal_factor: ``(N,)`` float32; metres per canonical metre.
        gravity: ``(N, 3)`` float32, unit direction of gravity in the view's camera frame; zeros unknown.
        place: ``(N,)`` int, index into the places.
        supervision: what the samples supervise.
    """

    tokens: NDArray[np.float16]
    class_tokens: NDArray[np.float16]
    image_rgb: NDArray[np.uint8]
    canonical_m: NDArray[np.float16]
    focal_factor: Floats32
    gravity: Floats32
    place: Ints
    supervision: Supervision = "both"

    def __len__(self) -> int:
        return len(self.place)


def sample_specs(config: ViewConfig, tapped: Tapped, dim: int, patch: int) -> dict[str, Spec]:
    """Shape and type of each array of one sample, for a backbone of ``dim`` channels and ``patch`` pixels."""
    rows, columns = config.rows, config.columns
    return {
        "tokens": ((tapped.count, dim, rows // patch, columns // patch), np.float16),
        "class_tokens": ((tapped.count, dim), np.float16),
        "image_rgb": ((rows, columns, 3), np.uint8),
        "canonical_m": ((rows, columns), np.float16),
        "focal_factor": ((), np.float32),
        "gravity": ((3,), np.float32),
    }


def build_cache(
    folder: Path,
    places: Sequence[Place],
    keys: Sequence[SampleKey],
    config: ViewConfig,
    backbone: DinoV2,
    tapped: Tapped,
    seed: int,
    *,
    device: str = "cpu",
    batch: int = 4,
    partners: Sequence[Partner] = (),
    progress: Progress = silent,
    stage: str = "features",
) -> FeatureCache:
    """Compute the missing samples of the cache in ``folder`` and open it.

    Args:
        batch: samples encoded at once.
        partners: places that are mixed into the views.

    Raises:
        DatasetError: an image or its depth cannot be read.
        OutputError: the folder cannot be written or the disk is too small.
    """
    with locked(folder):
        store = SampleStore(folder, len(keys), sample_specs(config, tapped, backbone.dim, backbone.patch))
        groups = store.groups_to_do(batch)
        if groups:
            logger.info("computing %d of %d samples into %s", sum(map(len, groups)), len(keys), folder)
        for count, group in enumerate(groups, start=1):
            views = [make_view(places, keys[k], config, seed, partners) for k in group]
            tokens, class_tokens = encode([view.image_rgb for view in views], backbone, tapped, device)
            store.put(
                group,
                tokens=tokens,
                class_tokens=class_tokens,
                image_rgb=np.stack([view.image_rgb for view in views]),
                canonical_m=np.stack([canonical_depth(view, config) for view in views]),
                focal_factor=[view.focal_px / CANONICAL_FOCAL_PX for view in views],
                gravity=np.stack([view.gravity for view in views]),
            )
            progress(TrainStep(stage, count, len(groups)))
        store.commit()
    arrays = store.arrays
    place = np.array([key.place for key in keys], dtype=np.int64)
    return FeatureCache(
        arrays["tokens"], arrays["class_tokens"], arrays["image_rgb"], arrays["canonical_m"],
        np.asarray(arrays["focal_factor"]), np.asarray(arrays["gravity"]), place,
    )  # fmt: skip


def encode(
    images_rgb: list[NDArray[np.uint8]], backbone: DinoV2, tapped: Tapped, device: str
) -> tuple[NDArray[np.float16], NDArray[np.float16]]:
    """Tokens ``(B, maps, dim, h, w)`` and class tokens ``(B, maps, dim)`` of ``images_rgb`` of one size."""
    import torch

    from slamdepth.depth.dinov2 import to_grid

    with torch.inference_mode():
        image = normalised(np.stack(images_rgb), device).to(backbone.cls_token.dtype)
        if tapped.entering is None:
            maps = backbone(image, tapped.taps)
        else:
            cells = backbone.cells(image)
            x, maps = backbone.run(backbone.embedded(image), range(tapped.entering), tapped.taps, cells)
            maps.append(to_grid(x, cells))
        tokens = torch.stack([grid for grid, _ in maps], dim=1)
        class_tokens = torch.stack([token for _, token in maps], dim=1)
    return tokens.half().cpu().numpy(), class_tokens.half().cpu().numpy()


def load_batch(
    cache: FeatureCache, chosen: Ints, device: str
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Tokens, class tokens, normalised images, gravity fields and canonical depth of the samples
    ``chosen (B,)``."""
    import torch

    rows, columns = cache.canonical_m.shape[1:]
    focal_px = torch.from_numpy(cache.focal_factor[chosen] * np.float32(CANONICAL_FOCAL_PX))
    return (
        torch.from_numpy(cache.tokens[chosen]).to(device).float(),
        torch.from_numpy(cache.class_tokens[chosen]).to(device).float(),
        normalised(cache.image_rgb[chosen], device),
        gravity_field(torch.from_numpy(cache.gravity[chosen]), focal_px, rows, columns).to(device),
        torch.from_numpy(cache.canonical_m[chosen]).to(device).float(),
    )


def load_mixed_batch(
    caches: Sequence[FeatureCache], chosen: Ints, device: str
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]:
    """A batch of samples from several caches.

    Args:
        chosen: ``(B, 2)``, cache and sample index of each.

    Returns:
        The batch as from :func:`load_batch`, sorted by cache; and ``(B, 2)`` of 0 and 1, whether each
        sample supervises shape and scale.
    """
    import torch

    present = np.unique(chosen[:, 0])
    each = [np.sort(chosen[chosen[:, 0] == c, 1]) for c in present]
    parts = [load_batch(caches[c], some, device) for c, some in zip(present, each, strict=True)]
    of_cache = [[caches[c].supervision in (branch, "both") for branch in ("shape", "scale")] for c in present]
    repeats = torch.tensor([len(some) for some in each])
    supervision = torch.tensor(of_cache, dtype=torch.float32).repeat_interleave(repeats, dim=0)
    tokens, class_tokens, image, field, depth = (torch.cat(part) for part in zip(*parts, strict=True))
    return (tokens, class_tokens, image, field, depth), supervision.to(device)
