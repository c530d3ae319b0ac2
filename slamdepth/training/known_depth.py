# SPDX-License-Identifier: Apache-2.0
"""Whether there is anything to learn depth from."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.training.caches import PlannedCache, of_member
from slamdepth.training.config import TrainConfig
from slamdepth.training.features import FeatureCache

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.training.out_of_fold import Fold

logger = logging.getLogger(__name__)


def check_known_depth(
    config: TrainConfig,
    planned: Sequence[PlannedCache],
    caches: Sequence[FeatureCache],
    folds: Sequence[Fold],
) -> None:
    """See that each head has a view with known depth to learn from; places that have none are logged.

    Raises:
        DatasetError: a head has none.
    """
    bounds = f"between {config.view.min_depth_m:g} and {config.view.max_depth_m:g} m"
    for plan, cache in zip(planned, caches, strict=True):
        for number, place in enumerate(plan.places if plan.teaches != "down" else ()):
            if not _any_known([(cache, np.flatnonzero(cache.place == number))]):
                logger.warning("%s: no view of it has depth %s", place.name, bounds)
    learnt = [
        [(cache, np.arange(len(cache))) for cache in of_member(planned, caches, member)]
        for member in range(config.members)
    ]
    learnt += [list(zip(caches, fold.learnt, strict=True)) for fold in folds]
    if not all(map(_any_known, learnt)):
        named = {place.name for plan in planned if plan.held_out is None for place in plan.places}
        raise DatasetError(
            f"{', '.join(sorted(named))}: no view that a head is to learn from has depth {bounds}; look at "
            "the depth images and their unit, or set view.min_depth_m and view.max_depth_m"
        )


def _any_known(views: Iterable[tuple[FeatureCache, NDArray[np.int64]]]) -> bool:
    """True where one of the samples ``(n,)`` of a cache has known depth; looks no further than that."""
    return any(bool((cache.canonical_m[k] > 0).any()) for cache, samples in views for k in samples)
