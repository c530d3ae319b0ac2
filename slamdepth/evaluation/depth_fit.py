# SPDX-License-Identifier: Apache-2.0
"""Alignment of predicted depth to the sensor's, for evaluation only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.evaluation.depth_pixels import MAX_M, MIN_M, ComparedPixels, as_depth
from slamdepth.types import DepthKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Values = NDArray[np.floating]


def fits_in(kind: DepthKind) -> str:
    """What the affine fit is linear in: ``"depth"`` or ``"inverse depth"``."""
    return "inverse depth" if kind is DepthKind.AFFINE_INVERSE_DEPTH else "depth"


def affine_fit(depth: Values, sensor_m: Values, kind: DepthKind) -> tuple[float, float]:
    """Factor and shift that bring a prediction closest to the sensor, by least squares.

    In depth, or in inverse depth (1/m) for inverse kinds, as Ranftl et al. (MiDaS, TPAMI
    2022) do; every pixel weighs the same. A constant prediction gets the factor 0.

    Args:
        depth: ``(N,)`` of :func:`~slamdepth.evaluation.depth_pixels.as_depth`, positive.
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
    """Metres of a prediction after :func:`affine_fit`, clipped to ``min_m`` to ``max_m``: a
    shift can make depth or inverse depth negative. 0, unknown, stays 0."""
    known = depth > 0
    fitted = fit[0] * _linear(np.where(known, depth, 1.0), kind) + fit[1]
    if kind is DepthKind.AFFINE_INVERSE_DEPTH:
        fitted = 1.0 / np.clip(fitted, 1.0 / max_m, 1.0 / min_m)
    return np.asarray(np.where(known, np.clip(fitted, min_m, max_m), 0.0), dtype=np.float64)


def _linear(depth: Values, kind: DepthKind) -> NDArray[np.float64]:
    depth = np.asarray(depth, dtype=np.float64)
    return np.asarray(1.0 / depth if kind is DepthKind.AFFINE_INVERSE_DEPTH else depth, dtype=np.float64)


def fitted_to_sensor(values: Values, kind: DepthKind, sensor_m: Values) -> NDArray[np.float64]:
    """One frame's prediction in metres, for images: scaled by the median, or by the affine fit where
    it is not metric. ``(H, W)``, 0 where there is none."""
    depth = as_depth(values, kind)
    compared = ComparedPixels(stride=1).take(values, sensor_m, kind)
    if compared is None:
        return depth
    if kind is DepthKind.METRIC:
        return depth * compared.factor
    fit = affine_fit(compared.depth, compared.sensor_m, kind)
    return apply_affine(depth, fit, kind, MIN_M, MAX_M)
