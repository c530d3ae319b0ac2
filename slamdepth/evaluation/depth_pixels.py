# SPDX-License-Identifier: Apache-2.0
"""The pixels of a predicted depth map that are compared with a sensor's, for all scores alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.types import DepthKind
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.floating]

MIN_M, MAX_M = 0.1, 10.0
"""Sensor depths outside are not compared."""
STRIDE = 4
"""One pixel in each square of this edge is compared."""


def as_depth(values: Values, kind: DepthKind) -> Floats:
    """Values of ``kind`` as depth up to a factor; 0 where there is none.

    Inverse depth is inverted as if its shift were 0. Values that are 0, negative or not finite
    are no prediction.
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values) & (values > 0)
    safe = np.where(known, values, 1.0)
    return np.where(known, 1.0 / safe if kind is DepthKind.AFFINE_INVERSE_DEPTH else safe, 0.0)


@dataclass(frozen=True)
class FramePixels:
    """The pixels of one frame that are compared; at least one.

    Attributes:
        depth: ``(N,)`` of :func:`as_depth`, positive.
        sensor_m: ``(N,)``, positive.
        ratios: ``(N,)`` sensor / predicted.
        factor: their median.
        where: ``(H, W)`` bool, True where compared; the other arrays are in its order.
    """

    depth: Floats
    sensor_m: Values
    ratios: Floats
    factor: float
    where: NDArray[np.bool_]


class ComparedPixels:
    """Picks the pixels to compare, frame by frame, and counts them.

    Args:
        min_m, max_m: sensor depths outside are not compared.
        stride: every ``stride``-th pixel of every ``stride``-th row is compared.

    Attributes:
        grid: slices of rows and columns, as ``stride`` says.
        pixels: compared so far.
        log_factors: natural logarithm of :attr:`FramePixels.factor` of each frame compared.
    """

    def __init__(self, *, min_m: float = MIN_M, max_m: float = MAX_M, stride: int = STRIDE) -> None:
        if not 0 < min_m < max_m:
            raise ValueError(f"need 0 < min_m < max_m, got {min_m} and {max_m}")
        if stride < 1:
            raise ValueError(f"stride must be positive, got {stride}")
        self.min_m, self.max_m = min_m, max_m
        self.grid = (slice(stride // 2, None, stride),) * 2
        self.pixels = 0
        self.log_factors: list[float] = []
        self._sensor_pixels = 0

    @property
    def frames(self) -> int:
        """Frames compared so far."""
        return len(self.log_factors)

    @property
    def coverage(self) -> float:
        """Share of the sensor's pixels that have a prediction, also in frames not compared."""
        return self.pixels / self._sensor_pixels

    def in_range(self, sensor_m: Values) -> Values:
        """``sensor_m`` where it is within the range, 0 elsewhere."""
        return np.where((sensor_m >= self.min_m) & (sensor_m <= self.max_m), sensor_m, 0.0)

    def take(self, values: Values, sensor_m: Values, kind: DepthKind) -> FramePixels | None:
        """Pick the pixels of one frame.

        Args:
            values: ``(H, W)`` predictions of ``kind``; values that are 0, negative or not finite
                are no prediction and only lower ``coverage``.
            sensor_m: ``(H, W)`` metres of the same pixels; 0 where unknown.

        Returns:
            None where no pixel has both; such a frame is not counted.

        Raises:
            ValueError: the two are not maps of one shape.
        """
        if values.ndim != 2 or values.shape != sensor_m.shape:
            raise ValueError(
                f"predicted and sensor depth must share one (H, W), got {values.shape} and {sensor_m.shape}"
            )
        depth, sensor = as_depth(values[self.grid], kind), self.in_range(sensor_m[self.grid])
        both = (depth > 0) & (sensor > 0)
        self._sensor_pixels += int((sensor > 0).sum())
        if not both.any():
            return None
        depth, sensor = depth[both], sensor[both]
        ratios = sensor / depth
        factor = float(np.median(ratios))
        where = np.zeros(values.shape, dtype=bool)
        where[self.grid] = both
        self.pixels += len(depth)
        self.log_factors.append(float(np.log(factor)))
        return FramePixels(depth, sensor, ratios, factor, where)
