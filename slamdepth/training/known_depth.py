# SPDX-License-Identifier: Apache-2.0
"""Check that there are views with known depth to train on."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.training.caches import PlannedCache, of_member
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache
from slamdepth.typing import Ints

if TYPE_CHECKING:
    from slamdepth.training.out_of_fold import Fold

logger = logging.getLogger(__name__)


def check_known_depth(
    config: TrainConfig,
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
    folds: Sequence[Fold],
) -> None:
    """Check that each head has a training view with known depth; log the places that have none.

    Raises:
        DatasetError: a head has no such view.
    """
    bounds = f"between {config.view.min_depth_m:g} and {config.view.max_depth_m:g} m"
    for plan, cache in zip(planned, caches, strict=True):
        for number, place in enumerate(plan.places if plan.supervision != "gravity" else ()):
            if not _any_known([(cache, np.flatnonzero(cache.place == number))]):
                logger.warning("%s: no view of it has depth %s", place.name, bounds)
    training = [
        [(cache, np.arange(len(cache))) for cache in of_member(planned, caches, member)]
        for member in range(config.members)
    ]
    training += [list(zip(caches, fold.training, strict=True)) for fold in folds]
    if not all(map(_any_known, training)):
        named = {place.name for plan in planned if plan.held_out is None for place in plan.places}
        raise DatasetError(
            f"{', '.join(sorted(named))}: no view that a head is to be trained on has depth {bounds}; check "
            "the depth images and their unit, or set view.min_depth_m and view.max_depth_m"
        )


def _any_known(views: Iterable[tuple[FeatureCache, Ints]]) -> bool:
    """True if any of the samples ``(n,)`` of a cache has known depth."""
    return any(bool((cache.canonical_m[k] > 0).any()) for cache, samples in views for k in samples)
