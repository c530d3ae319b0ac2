# SPDX-License-Identifier: Apache-2.0
"""Structural similarity and edge accuracy of depth maps, on known pixels only.

Sensor depth has holes, most of them at edges. Both measures equal the published ones where there is no
hole, and use the known pixels around one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.typing import Bools

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Map = NDArray[np.floating]

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
_K1, _K2 = 0.01, 0.03
_NO_WEIGHT = 1e-12

JUMPS = np.linspace(1.05, 1.25, 10)
"""Ratios of depth that count as an edge; each is also its own weight."""
LOCATED_JUMP = 1.10
"""The ratio at which edges are located for the distance in pixels."""
REFERENCE_WIDTH = 640
LARGEST_GAP_PX, LARGEST_DISTANCE_PX = 20, 10.0
"""In pixels of an image 640 wide; scaled in proportion for others."""


@dataclass(frozen=True)
class EdgeScore:
    """How well the edges of a predicted map agree with those of the sensor's.

    Attributes:
        f1: F-score of depth discontinuities, 0 to 1; 1 is best. The weighted mean over the
            jumps :data:`JUMPS` of the harmonic mean of precision and recall.
        error_px: distance between the edges of the two, the mean of both directions, in
            pixels of an image 640 wide; at most 10, which an edge without partner counts.
    """

    f1: float
    error_px: float


def ssim_map(x: Any, y: Any, weight: Any, blur: Callable[[Any], Any], data_range: Any) -> Any:
    """Structural similarity of every pixel's window (Wang et al., TIP 2004).

    Written in operators alone, so it takes arrays and tensors alike.

    Args:
        x, y: maps; their values where ``weight`` is 0 do not matter if finite.
        weight: 1 where both are known, else 0; windows average over known pixels.
        blur: the window's weighted sum, with zeros beyond the border.
        data_range: largest value less the smallest possible one.
    """
    total = blur(weight) + _NO_WEIGHT
    mean_x, mean_y = blur(x * weight) / total, blur(y * weight) / total
    variance_x = blur(x * x * weight) / total - mean_x * mean_x
    variance_y = blur(y * y * weight) / total - mean_y * mean_y
    covariance = blur(x * y * weight) / total - mean_x * mean_y
    c1, c2 = (_K1 * data_range) ** 2, (_K2 * data_range) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x * mean_x + mean_y * mean_y + c1)
    return luminance * (2 * covariance + c2) / (variance_x + variance_y + c2)


def depth_ssim(predicted_m: Map, sensor_m: Map, known: Bools) -> float:
    """SSIM of two depth maps in metres, the mean over the ``known`` pixels.

    Windows are Gaussian, 11 x 11 with a deviation of 1.5 pixels, renormalised over their
    known pixels; K1 = 0.01, K2 = 0.03, and the data range is the sensor's largest known depth.

    Args:
        predicted_m, sensor_m: ``(H, W)``.
        known: ``(H, W)``, at least one True; where both are known.
    """
    import cv2

    def blur(a: NDArray[np.float64]) -> NDArray[np.float64]:
        size = (SSIM_WINDOW, SSIM_WINDOW)
        blurred = cv2.GaussianBlur(a, size, SSIM_SIGMA, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred)

    x, y = (np.where(known, a, 0.0).astype(np.float64) for a in (predicted_m, sensor_m))
    similar = ssim_map(x, y, known.astype(np.float64), blur, float(y.max()))
    return float(np.asarray(similar)[known].mean())


def edge_score(predicted_m: Map, sensor_m: Map, known: Bools) -> EdgeScore | None:
    """Compare depth discontinuities; the unit of either map does not matter.

    ``f1`` is after the boundary F1 of Depth Pro (Bochkovskii et al. 2024): two neighbours are
    an edge where the depth of one is more than ``t`` times the other's, to the left, right,
    above and below each on its own, for t from 1.05 to 1.25. Two changes: neighbours are each
    known pixel and the next known one of its row or column, up to 20 pixels on, so that an
    edge next to a sensor's shadow still counts; and the four directions are counted
    together, so that a perfect map has 1 whichever of them occur.

    ``error_px`` is after the depth boundary errors of iBims-1 (Koch et al., ECCV workshops
    2018), accuracy and completeness averaged, with edges of t = 1.10 in place of annotated
    ones; an edge lies at its nearer pixel, which is seen by both.

    Args:
        predicted_m, sensor_m: ``(H, W)``, positive where known.
        known: ``(H, W)``; where both are known.

    Returns:
        None where the sensor's map has no edge.
    """
    unit_px = known.shape[1] / REFERENCE_WIDTH
    gap = max(1, round(LARGEST_GAP_PX * unit_px))
    predicted, sensor = (np.log(np.where(known, a, 1.0).astype(np.float64)) for a in (predicted_m, sensor_m))
    pairs = [_neighbours(known, axis, gap) for axis in (0, 1)]
    jumps_predicted = np.concatenate([predicted.ravel()[b] - predicted.ravel()[a] for a, b in pairs])
    jumps_sensor = np.concatenate([sensor.ravel()[b] - sensor.ravel()[a] for a, b in pairs])
    scores, weights = [], []
    for ratio in JUMPS:
        log_ratio = math.log(ratio)
        there, found = np.abs(jumps_sensor) > log_ratio, np.abs(jumps_predicted) > log_ratio
        if there.any():
            right = int((there & found & (np.sign(jumps_sensor) == np.sign(jumps_predicted))).sum())
            scores.append(2 * right / int(there.sum() + found.sum()))
            weights.append(ratio)
    if not scores:
        return None
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    at_sensor, at_predicted = (
        _located(jumps, first, second, known.shape, math.log(LOCATED_JUMP))
        for jumps in (jumps_sensor, jumps_predicted)
    )
    error_px = math.nan
    if at_sensor.any():
        there_and_back = ((at_sensor, at_predicted), (at_predicted, at_sensor))
        error_px = float(np.mean([_mean_distance(a, b, unit_px) for a, b in there_and_back]))
    return EdgeScore(float(np.average(scores, weights=weights)), error_px)


def _neighbours(known: Bools, axis: int, gap: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat indices of each known pixel and of the next known one along ``axis``, up to ``gap`` on."""
    flat = np.arange(known.size).reshape(known.shape)
    turned, flat = (known, flat) if axis == 1 else (known.T, flat.T)
    columns = turned.shape[1]
    position = np.where(turned, np.arange(columns), columns + gap)
    following = np.minimum.accumulate(position[:, ::-1], axis=1)[:, ::-1][:, 1:]
    rows, first = np.nonzero(turned[:, :-1] & (following - np.arange(columns - 1) <= gap))
    return flat[rows, first], flat[rows, following[rows, first]]


def _located(
    jumps: NDArray[np.float64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    shape: tuple[int, ...],
    log_ratio: float,
) -> Bools:
    mask = np.zeros(shape, dtype=bool)
    mask.ravel()[first[jumps > log_ratio]] = True
    mask.ravel()[second[jumps < -log_ratio]] = True
    return mask


def _mean_distance(edges: Bools, others: Bools, unit_px: float) -> float:
    """Mean distance from each pixel of ``edges`` to the nearest of ``others``, at most 10."""
    import cv2

    if not edges.any() or not others.any():
        return LARGEST_DISTANCE_PX
    distance = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(np.minimum(distance[edges] / unit_px, LARGEST_DISTANCE_PX).mean())
