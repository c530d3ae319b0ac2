# SPDX-License-Identifier: Apache-2.0
"""From what a model's numbers mean to metres, by the sensor's own depth; for judging only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.floating]


def as_depth(values: Values, kind: DepthKind) -> NDArray[np.float64]:
    """Values of ``kind`` as depth up to a factor; 0 where there is none.

    Inverse depth is inverted as if its shift were 0. What is 0, negative or not finite is
    no prediction.
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values) & (values > 0)
    safe = np.where(known, values, 1.0)
    return np.where(known, 1.0 / safe if kind is DepthKind.AFFINE_INVERSE_DEPTH else safe, 0.0)


def fits_in(kind: DepthKind) -> str:
    """What the affine fit is linear in: ``"depth"`` or ``"inverse depth"``."""
    return "inverse depth" if kind is DepthKind.AFFINE_INVERSE_DEPTH else "depth"


def affine_fit(depth: Values, sensor_m: Values, kind: DepthKind) -> tuple[float, float]:
    """Factor and shift that bring a prediction closest to the sensor, by least squares.

    In depth, or in inverse depth (1/m) for inverse kinds, as Ranftl et al. (MiDaS, TPAMI
    2022) do; every pixel weighs the same. A prediction without relief gets the factor 0.

    Args:
        depth: ``(N,)`` of :func:`as_depth`, positive.
        sensor_m: ``(N,)``, positive.
    """
    x, y = (_linear(a, kind) for a in (depth, sensor_m))
    mean_x, mean_y = x.mean(), y.mean()
    variance = float(np.mean((x - mean_x) ** 2))
    if variance <= 1e-12 * max(float(mean_x) ** 2, 1e-30):
        return 0.0, float(mean_y)
    factor = float(np.mean((x - mean_x) * (y - mean_y))) / variance
    return factor, float(mean_y - factor * mean_x)


def apply_affine(
    depth: Values, fit: tuple[float, float], kind: DepthKind, min_m: float, max_m: float
) -> NDArray[np.float64]:
    """Metres of a prediction after :func:`affine_fit`, held within ``min_m`` to ``max_m``: a
    shift can push depth below 0, or inverse depth beyond infinity. 0 stays 0."""
    known = depth > 0
    fitted = fit[0] * _linear(np.where(known, depth, 1.0), kind) + fit[1]
    if kind is DepthKind.AFFINE_INVERSE_DEPTH:
        fitted = 1.0 / np.clip(fitted, 1.0 / max_m, 1.0 / min_m)
    return np.asarray(np.where(known, np.clip(fitted, min_m, max_m), 0.0), dtype=np.float64)


def _linear(depth: Values, kind: DepthKind) -> NDArray[np.float64]:
    depth = np.asarray(depth, dtype=np.float64)
    return np.asarray(1.0 / depth if kind is DepthKind.AFFINE_INVERSE_DEPTH else depth, dtype=np.float64)


def fitted_to_sensor(
    values: Values, kind: DepthKind, sensor_m: Values, min_m: float = 0.1, max_m: float = 10.0
) -> NDArray[np.float64]:
    """One frame's prediction in metres, to look at: after the median, or the affine fit where
    its numbers are no metres. ``(H, W)``, 0 where there is none."""
    depth = as_depth(values, kind)
    both = (depth > 0) & (sensor_m >= min_m) & (sensor_m <= max_m)
    if not both.any():
        return depth
    if kind is DepthKind.METRIC:
        return np.asarray(depth * np.median(sensor_m[both] / depth[both]), dtype=np.float64)
    return apply_affine(depth, affine_fit(depth[both], sensor_m[both], kind), kind, min_m, max_m)
