# SPDX-License-Identifier: Apache-2.0
"""Distribution of the depths of a data set, counted image by image in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BIN_M = 0.001
"""Width of a bin: percentiles are exact to half of it."""
END_M = 200.0
"""Larger depths count in the last bin; the maximum is exact."""
PERCENTILES = (1, 5, 50, 95, 99)


@dataclass
class DepthStatistics:
    """Counts over depth images; :meth:`add` them one by one.

    Attributes:
        images, pixels: how many were added.
        known: pixels that have a depth.
        known_shares: share of the pixels with depth in each image.
        nearest_m, farthest_m: the exact extremes.
    """

    images: int = 0
    pixels: int = 0
    known: int = 0
    known_shares: list[float] = field(default_factory=list)
    nearest_m: float = np.inf
    farthest_m: float = 0.0
    _counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(round(END_M / BIN_M), np.int64))

    def add(self, depth_m: NDArray[np.floating]) -> None:
        """Count an image ``(H, W)`` of metres; values that are 0, negative or not finite are unknown."""
        known_m = depth_m[np.isfinite(depth_m) & (depth_m > 0)].astype(np.float64)
        self.images += 1
        self.pixels += depth_m.size
        self.known += len(known_m)
        self.known_shares.append(len(known_m) / max(depth_m.size, 1))
        if len(known_m):
            self.nearest_m = min(self.nearest_m, float(known_m.min()))
            self.farthest_m = max(self.farthest_m, float(known_m.max()))
            bins = np.minimum(known_m / BIN_M, len(self._counts) - 1).astype(np.int64)
            self._counts += np.bincount(bins, minlength=len(self._counts))

    def percentile_m(self, percent: float) -> float | None:
        """The depth below which ``percent`` of the known pixels lie; None where there are none."""
        if not self.known:
            return None
        place = int(np.searchsorted(np.cumsum(self._counts), percent / 100.0 * self.known))
        return float(np.clip((place + 0.5) * BIN_M, self.nearest_m, self.farthest_m))

    def histogram(self, edges_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """Known pixels ``(N,)`` between ``(N + 1,)`` rising edges, which are rounded to millimetres."""
        below = np.concatenate([[0], np.cumsum(self._counts)])
        places = np.clip(np.rint(edges_m / BIN_M).astype(np.int64), 0, len(self._counts))
        return np.diff(below[places])

    def to_dict(self) -> dict[str, Any]:
        """The figures as a dict of numbers; None where no pixel has a depth."""
        return {
            "images": self.images,
            "pixels": self.pixels,
            "without_depth": 1.0 - self.known / self.pixels if self.pixels else None,
            "without_depth_per_image": _spread([1.0 - share for share in self.known_shares]),
            "min_m": self.nearest_m if self.known else None,
            **{f"p{percent}_m": self.percentile_m(percent) for percent in PERCENTILES},
            "max_m": self.farthest_m if self.known else None,
        }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"min": min(values), "median": float(np.median(values)), "max": max(values)}
