# SPDX-License-Identifier: Apache-2.0
"""One scale, and a shift where needed, for all predictions of a sequence.

The kind of a model decides what is scaled and shifted: metric and affine depth as depth, affine inverse depth
as inverse depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.robust_line import robust_line
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.evaluation.bootstrap import block_resamples
from slamdepth.evaluation.depth_pixels import MAX_M, MIN_M, STRIDE
from slamdepth.types import DepthKind, Frame, WeightsInfo
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


_MIN_PIXELS = 50
_MAX_SAMPLES = 20_000
_RESAMPLES = 200


class ScaleDomain(str, Enum):
    """What is scaled and shifted: depth, with a shift in metres, or inverse depth, with a shift in 1/m."""

    DEPTH = "depth"
    INVERSE_DEPTH = "inverse depth"

    @property
    def shift_unit(self) -> str:
        """``"m"`` or ``"1/m"``."""
        return "m" if self is ScaleDomain.DEPTH else "1/m"

    @classmethod
    def of(cls, kind: DepthKind) -> ScaleDomain:
        """The domain in which predictions of this kind are scaled."""
        return cls.INVERSE_DEPTH if kind is DepthKind.AFFINE_INVERSE_DEPTH else cls.DEPTH


@dataclass(frozen=True)
class DepthScale:
    """A linear map from a model's values to depth: ``scale * value + shift``.

    Attributes:
        scale: factor, above 0.
        shift: in m or 1/m.
        domain: whether the result is depth in metres or inverse depth in 1/m.
    """

    scale: float
    shift: float = 0.0
    domain: ScaleDomain = ScaleDomain.DEPTH

    def depth_m(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Depth ``(H, W)`` in metres from a model's values; 0 where unknown or not in front of the camera."""
        known = np.isfinite(values) & (values != 0)
        line = self.scale * np.asarray(values, dtype=np.float64) + self.shift
        known &= line > 1e-6
        line = np.where(known, line, 1.0)
        depth_m = line if self.domain is ScaleDomain.DEPTH else 1.0 / line
        return np.where(known, depth_m, 0.0).astype(np.float32)


@dataclass(frozen=True)
class ScaleFit:
    """A :class:`DepthScale` fitted to a depth sensor, and its uncertainty.

    Attributes:
        scale: the fit.
        sequence: name of the sequence it was fitted to.
        model: name of the model whose predictions were compared.
        kind: what the model's values mean.
        weights: of the model.
        scale_sigma_log: standard error of the natural log of ``scale.scale``. With a shift it is the standard
            error of the log of depth at the median depth instead: the errors of scale and shift are
            correlated, and that of the scale alone says little. None with one frame.
        shift_sigma: standard error of the shift in its unit; None without a shift.
        frames: number of frames compared.
        pixels: number of pixels compared.
        frame_spread_log: standard deviation over frames of the log of each frame's own factor on the common
            fit: how stable the model's scale is from frame to frame.
        sequence_id: hash of the sequence, which distinguishes it from others of that name; empty where it is
            unknown.
    """

    scale: DepthScale
    sequence: str
    model: str
    kind: DepthKind
    weights: tuple[WeightsInfo, ...]
    scale_sigma_log: float | None
    shift_sigma: float | None
    frames: int
    pixels: int
    frame_spread_log: float
    sequence_id: str = ""


def needs_shift(kind: DepthKind) -> bool:
    """Whether predictions of this kind need a shift, next to a scale, to become metric."""
    return kind is not DepthKind.METRIC


def fit_scale(
    model: DepthModel, frames: Iterable[Frame], *, with_shift: bool, sequence: str, sequence_id: str = ""
) -> ScaleFit:
    """Fit the scale of a model's predictions to the sensor's depth of a sequence.

    Without a shift the scale is the median over frames of each frame's median ratio, so that every frame
    weighs the same. With a shift a line is fitted robustly to all pixels. Standard errors come from a
    bootstrap over blocks of frames, because errors are correlated within a frame and between neighbours.

    Args:
        model: any but a sensor.
        frames: in order of time; those without sensor depth are skipped.
        with_shift: fit a shift too.
        sequence: name of the sequence.
        sequence_id: hash of the sequence.

    Raises:
        ConfigError: a relative model without a shift, or a model that is a sensor.
        DatasetError: no frame can be compared, or the predictions do not increase with the sensor's.
    """
    check_can_fit(model, with_shift)
    values, sensor_m = _samples(model, frames)
    if not values:
        raise DatasetError(f"{sequence}: no frame has sensor depth to fit the scale of '{model.name}' to")
    domain = ScaleDomain.of(model.kind)
    resamples = block_resamples(len(values), resamples=_RESAMPLES) if len(values) > 1 else None
    if with_shift:
        scale, sigma_log, shift_sigma = _fit_line(values, sensor_m, domain, resamples, model.name)
    else:
        each = np.array([float(np.median(np.log(s / v))) for v, s in zip(values, sensor_m, strict=True)])
        scale = DepthScale(float(np.exp(np.median(each))), 0.0, domain)
        sigma_log = None if resamples is None else float(np.std(np.median(each[resamples], axis=1)))
        shift_sigma = None
    return ScaleFit(
        scale=scale,
        sequence=sequence,
        model=model.name,
        kind=model.kind,
        weights=model.weights,
        scale_sigma_log=sigma_log,
        shift_sigma=shift_sigma,
        frames=len(values),
        pixels=sum(map(len, values)),
        frame_spread_log=_frame_spread(scale, values, sensor_m),
        sequence_id=sequence_id,
    )


def check_can_fit(model: DepthModel, with_shift: bool) -> None:
    """Check that a scale of this model's predictions can be fitted.

    Raises:
        ConfigError: the model is a sensor, or relative and to be fitted without a shift.
    """
    if is_sensor(model):
        raise ConfigError("the sensor's depth is in metres already: only predicted depth has a scale to fit")
    if needs_shift(model.kind) and not with_shift:
        raise ConfigError(
            f"depth model '{model.name}' predicts {model.kind.value}, known up to scale and shift: "
            "fit both (--shift)"
        )


def _samples(model: DepthModel, frames: Iterable[Frame]) -> tuple[list[Floats], list[Floats]]:
    """Predicted values and sensor depths in metres of the same pixels, frame by frame."""
    values: list[Floats] = []
    sensor_m: list[Floats] = []
    grid = slice(STRIDE // 2, None, STRIDE)
    for frame in frames:
        if frame.depth_m is None:
            continue
        value = model.predict(frame).values[grid, grid].ravel().astype(np.float64)
        measured = frame.depth_m[grid, grid].ravel().astype(np.float64)
        both = (measured >= MIN_M) & (measured <= MAX_M)
        both &= np.isfinite(value) & (value > 0 if model.kind is DepthKind.METRIC else value != 0)
        if np.count_nonzero(both) >= _MIN_PIXELS:
            values.append(value[both])
            sensor_m.append(measured[both])
    return values, sensor_m


def _fit_line(
    values: list[Floats],
    sensor_m: list[Floats],
    domain: ScaleDomain,
    resamples: NDArray[np.int64] | None,
    name: str,
) -> tuple[DepthScale, float | None, float | None]:
    each = max(_MIN_PIXELS, _MAX_SAMPLES // len(values))
    x = [v[:: max(1, len(v) // each)] for v in values]
    z = [s[:: max(1, len(s) // each)] for s in sensor_m]
    y = z if domain is ScaleDomain.DEPTH else [1.0 / s for s in z]
    try:
        slope, intercept, spread = robust_line(np.concatenate(x), np.concatenate(y))
    except ValueError as error:
        raise DatasetError(f"'{name}' predicts the same value everywhere: no scale can be fitted") from error
    if slope <= 0:
        raise DatasetError(
            f"'{name}' predicts {domain.value} that falls where the sensor's rises: no scale can be fitted"
        )
    scale = DepthScale(slope, intercept, domain)
    if resamples is None:
        return scale, None, None
    lines = []
    for chosen in resamples:
        resampled = np.concatenate([x[i] for i in chosen]), np.concatenate([y[i] for i in chosen])
        lines.append(robust_line(*resampled, start=(slope, intercept), spread=spread)[:2])
    slopes, intercepts = np.array(lines).T
    middle = float(np.median(np.concatenate(x)))
    at_middle = np.maximum(slopes * middle + intercepts, 1e-9)
    return scale, float(np.std(np.log(at_middle))), float(np.std(intercepts))


def _frame_spread(scale: DepthScale, values: list[Floats], sensor_m: list[Floats]) -> float:
    """Standard deviation over frames of the log of each frame's own factor on ``scale``."""
    factors = []
    for value, measured in zip(values, sensor_m, strict=True):
        depth_m = scale.depth_m(value)
        if (known := depth_m > 0).any():
            factors.append(float(np.median(np.log(measured[known] / depth_m[known]))))
    return float(np.std(factors)) if factors else 0.0
