# SPDX-License-Identifier: Apache-2.0
"""From a depth prediction to metres of the map.

The only place where a :class:`DepthPrediction` becomes depth. The error of a prediction is modelled as mostly
common to the image and otherwise smooth over the image and over surfaces. It is observed wherever the map
already has a landmark and interpolated in between, by Gaussian process regression of the log ratio of map
depth to predicted depth over pixel position and predicted depth (Rasmussen and Williams, "Gaussian Processes
for Machine Learning", 2006, eq. 2.25-2.26). Far from landmarks the uncertainty of the prior remains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.robust import robust_deviation
from slamdepth.types import DepthKind, DepthPrediction
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


DEFAULT_SIGMA_LOG = 0.25
"""Standard deviation of log depth, assumed where a model gives none."""

SHAPE_SIGMA_LOG = 0.4
"""Standard deviation of log depth over an indoor image."""

MAX_ANCHORS = 300
"""Most landmarks that a field is fitted to."""


@dataclass(frozen=True)
class FieldSettings:
    """Covariance of the prediction's error.

    Attributes:
        length_px: correlation length over the image, in pixels of an image 640 wide.
        length_log: correlation length over log depth: points at another depth belong to another surface.
        white_share: share of the variance that is independent from pixel to pixel.
        common_sigma: standard deviation of the log scale common to the image.
    """

    length_px: float = 80.0
    length_log: float = 0.3
    white_share: float = 0.2
    common_sigma: float = 0.3


class DepthField:
    """A prediction fitted to landmarks: correction of log depth and its standard deviation at any pixel.

    Made by :func:`fit_depth_field`.

    Attributes:
        offset: log ratio of map to prediction, expected before any landmark is observed.
    """

    def __init__(
        self,
        anchor_px: Floats,
        anchor_log: Floats,
        anchor_sigma: Floats,
        solved: Floats,
        factor: tuple[Floats, bool] | None,
        offset: float,
        unit_px: float,
        settings: FieldSettings,
    ) -> None:
        self._px, self._log, self._sigma = anchor_px, anchor_log, anchor_sigma
        self._solved, self._factor = solved, factor
        self.offset = offset
        self._unit_px = unit_px
        self._settings = settings

    @property
    def anchors(self) -> int:
        """Number of landmarks the field was fitted to."""
        return len(self._px)

    def correction(self, px: Floats, log_predicted: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Correction of log depth and its posterior standard deviation at pixels.

        Args:
            px: ``(N, 2)`` raw pixels.
            log_predicted: ``(N,)`` natural log of predicted depth.
            sigma: ``(N,)`` the prediction's own standard deviation.

        Returns:
            ``(correction (N,), sigma (N,))``; add the first to ``log_predicted``.
        """
        s = self._settings
        variance = sigma**2 + s.common_sigma**2
        if self._factor is None:
            return np.full(len(px), self.offset), np.sqrt(variance)
        from scipy.linalg import solve_triangular

        K = self._kernel(px, log_predicted, sigma, self._px, self._log, self._sigma)
        mean = self.offset + K @ self._solved
        L = self._factor[0].astype(np.float32)
        half = solve_triangular(L, K.T, lower=self._factor[1], check_finite=False)
        reduction = np.einsum("ij,ij->j", half, half)
        floor = s.white_share * sigma**2
        return mean, np.sqrt(np.maximum(variance - reduction, np.maximum(floor, 1e-6)))

    def mean(self, px: Floats, log_predicted: Floats, sigma: Floats) -> Floats:
        """Correction of log depth ``(N,)`` at pixels, without its deviation: cheaper, for dense maps.

        Args:
            px: ``(N, 2)`` raw pixels.
            log_predicted: ``(N,)`` natural log of predicted depth.
            sigma: ``(N,)`` the prediction's own standard deviation.
        """
        if self._factor is None:
            return np.full(len(px), self.offset)
        return (
            self.offset
            + self._kernel(px, log_predicted, sigma, self._px, self._log, self._sigma) @ self._solved
        )

    def _kernel(
        self, pa: Floats, la: Floats, sa: Floats, pb: Floats, lb: Floats, sb: Floats
    ) -> NDArray[np.float32]:
        """Covariance ``(A, B)`` of the error, in single precision: much faster and accurate enough."""
        s = self._settings
        scale = np.array([s.length_px * self._unit_px, s.length_px * self._unit_px, s.length_log])
        a, b = ((np.column_stack([p, log]) / scale).astype(np.float32) for p, log in ((pa, la), (pb, lb)))
        K: NDArray[np.float32] = a @ b.T
        K -= 0.5 * (a * a).sum(1)[:, None]
        K -= 0.5 * (b * b).sum(1)[None]
        np.exp(np.minimum(K, 0.0, out=K), out=K)
        K *= ((1.0 - s.white_share) * sa).astype(np.float32)[:, None]
        K *= sb.astype(np.float32)[None]
        K += np.float32(s.common_sigma**2)
        return K


def log_depth_at(prediction: DepthPrediction, px: Floats) -> tuple[Floats, Floats]:
    """Natural log of predicted depth and its standard deviation at pixels, by nearest neighbour.

    Args:
        prediction: metric.
        px: ``(N, 2)`` raw pixels.

    Returns:
        ``(log depth (N,), sigma (N,))``; log depth is NaN where it is unknown.

    Raises:
        TrackingError: the prediction is not metric. Relative depth has to be scaled first; taking disparity
            for depth is never right.
    """
    u = np.clip(np.rint(px[:, 0]).astype(np.int64), 0, prediction.values.shape[1] - 1)
    v = np.clip(np.rint(px[:, 1]).astype(np.int64), 0, prediction.values.shape[0] - 1)
    sigma = prediction.sigma_log
    return _log_metric(prediction, prediction.values[v, u]), (
        np.full(len(px), DEFAULT_SIGMA_LOG) if sigma is None else sigma[v, u].astype(np.float64)
    )


def prior_log_depth_at(prediction: DepthPrediction, px: Floats) -> tuple[Floats, Floats]:
    """Prior log depth and its standard deviation at pixels: the prediction, shrunk where it is uncertain.

    Log depth varies over an indoor image by about ``SHAPE_SIGMA_LOG``. The prior is the posterior mean of two
    Gaussians, that one and the prediction, so an uncertain prediction shrinks towards a wall at its own
    median distance. A wrong shape is worse than a flat one: it makes a sideways motion look like a rotation.

    Args:
        prediction: metric.
        px: ``(N, 2)`` raw pixels.

    Returns:
        ``(log depth (N,), sigma (N,))``; log depth is NaN where it is unknown.

    Raises:
        TrackingError: the prediction is not metric.
    """
    log, sigma = log_depth_at(prediction, px)
    centre, gain = _centre(prediction), _gain(sigma)
    return centre + gain * (log - centre), sigma * np.sqrt(gain)


def _gain(sigma_log: Any) -> Any:
    """Share of a deviation from the image's median that is kept, 0 to 1."""
    return SHAPE_SIGMA_LOG**2 / (SHAPE_SIGMA_LOG**2 + sigma_log**2)


def _centre(prediction: DepthPrediction) -> float:
    """Median log depth of the whole image."""
    values = prediction.values[::4, ::4]
    log = _log_metric(prediction, values)
    return float(np.nanmedian(log)) if np.isfinite(log).any() else 0.0


def _log_metric(prediction: DepthPrediction, values: NDArray[np.float32]) -> Floats:
    if prediction.kind is not DepthKind.METRIC:
        raise TrackingError(
            f"a {prediction.kind.value} map cannot be read as metres; use a metric depth model"
        )
    known = np.isfinite(values) & (values > 0)
    return np.where(known, np.log(np.where(known, values, 1.0), dtype=np.float64), np.nan)


def fit_depth_field(
    px: Floats,
    log_predicted: Floats,
    sigma: Floats,
    log_map: Floats,
    sigma_map: Floats,
    *,
    width: int,
    prior_offset: float = 0.0,
    settings: FieldSettings | None = None,
) -> DepthField:
    """Fit the error of a prediction to landmarks.

    Args:
        px: ``(N, 2)`` raw pixels of landmarks.
        log_predicted: ``(N,)`` natural log of predicted depth there; NaN is left out.
        sigma: ``(N,)`` standard deviation of ``log_predicted``.
        log_map: ``(N,)`` natural log of the landmarks' depth in this camera; outliers are left out.
        sigma_map: ``(N,)`` standard deviation of ``log_map``.
        width: of the image in pixels, by which ``length_px`` is scaled.
        prior_offset: log ratio of map to prediction, expected before any landmark is observed.
        settings: covariance of the error.
    """
    settings = settings or FieldSettings()
    ratio = log_map - log_predicted
    good = np.isfinite(ratio) & np.isfinite(sigma) & np.isfinite(sigma_map)
    if np.count_nonzero(good) >= 8:
        median = np.median(ratio[good])
        spread = robust_deviation(ratio[good], median) + 0.02
        good &= np.abs(ratio - median) < 3.5 * spread
    index = np.flatnonzero(good)
    if len(index) > MAX_ANCHORS:
        best = index[np.argsort(sigma_map[index], kind="stable")[: 2 * MAX_ANCHORS]]
        index = np.sort(best[:: max(1, len(best) // MAX_ANCHORS)][:MAX_ANCHORS])
    unit_px = width / 640.0
    field = DepthField(
        px[index],
        log_predicted[index],
        sigma[index],
        np.zeros(len(index)),
        None,
        prior_offset,
        unit_px,
        settings,
    )
    if len(index) == 0:
        return field
    from scipy.linalg import cho_factor, cho_solve

    K = field._kernel(field._px, field._log, field._sigma, field._px, field._log, field._sigma)
    noise = sigma_map[index] ** 2 + settings.white_share * sigma[index] ** 2 + 1e-4
    factor = cho_factor(K.astype(np.float64) + np.diag(noise), lower=True, check_finite=False)
    solved = cho_solve(factor, ratio[index] - prior_offset, check_finite=False)
    return DepthField(field._px, field._log, field._sigma, solved, factor, prior_offset, unit_px, settings)


def coarse_correction(
    field: DepthField, prediction: DepthPrediction, step_px: int = 16
) -> NDArray[np.float32]:
    """Correction of a whole prediction's log depth, on a coarse grid.

    The correction is smooth, so one value about every ``step_px`` pixels is enough.

    Args:
        field: fitted to the prediction.
        prediction: metric.
        step_px: distance of grid points in pixels; the grid covers the image from edge to edge.

    Returns:
        ``(h, w)`` float32.

    Raises:
        TrackingError: the prediction is not metric.
    """
    height, width = prediction.values.shape
    # The grid ends on the last row and column, so that nothing is extrapolated.
    rows = np.linspace(0, height - 1, -(-(height - 1) // step_px) + 1)
    cols = np.linspace(0, width - 1, -(-(width - 1) // step_px) + 1)
    grid_u, grid_v = np.meshgrid(cols, rows)
    px = np.column_stack([grid_u.ravel(), grid_v.ravel()]).astype(np.float64)
    log, sigma = prior_log_depth_at(prediction, px)
    centre = _centre(prediction)
    sigma = np.nan_to_num(sigma, nan=DEFAULT_SIGMA_LOG)
    coarse = field.mean(px, np.nan_to_num(log, nan=centre), sigma).reshape(grid_u.shape)
    return np.asarray(coarse, np.float32)


def as_given(prediction: DepthPrediction) -> NDArray[np.float32]:
    """Depth ``(H, W)`` of a prediction whose metres are the map's, such as a sensor's; 0 = unknown."""
    return prediction.values


def corrected_depth(coarse: NDArray[np.float32], prediction: DepthPrediction) -> NDArray[np.float32]:
    """Depth of a prediction in metres of the map: its prior with the correction added.

    Args:
        coarse: ``(h, w)`` from :func:`coarse_correction`.
        prediction: metric, the one that ``coarse`` was made for.

    Returns:
        ``(H, W)`` float32, 0 = unknown.

    Raises:
        TrackingError: the prediction is not metric.
    """
    import cv2

    height, width = prediction.values.shape
    map_u, map_v = np.meshgrid(
        np.linspace(0, coarse.shape[1] - 1, width, dtype=np.float32),
        np.linspace(0, coarse.shape[0] - 1, height, dtype=np.float32),
    )
    dense = cv2.remap(coarse, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    centre = _centre(prediction)
    values = prediction.values.astype(np.float32, copy=False)
    known = np.isfinite(values) & (values > 0)
    log = np.log(np.where(known, values, np.float32(1.0)))
    log -= np.float32(centre)
    if prediction.sigma_log is None:
        log *= np.float32(_gain(DEFAULT_SIGMA_LOG))
    else:  # single precision: arithmetic in half precision is many times slower
        sigma = prediction.sigma_log.astype(np.float32)
        log *= _gain(np.nan_to_num(sigma, copy=False, nan=DEFAULT_SIGMA_LOG))
    log += dense
    log += np.float32(centre)
    depth_m = np.exp(log, out=log)
    depth_m[~known] = 0.0
    return depth_m
