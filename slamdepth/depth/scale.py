# SPDX-License-Identifier: Apache-2.0
"""One scale, and where it needs one a shift, for all predictions of a sequence.

In which domain a model's numbers are scaled and shifted follows from its kind: metric and
affine depth as depth, affine inverse depth as inverse depth.
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


_FEWEST_PIXELS = 50
_MOST_SAMPLES = 20_000
_RESAMPLES = 200


class ScaleDomain(str, Enum):
    """What is scaled and shifted; the shift is in metres or in one over metres."""

    DEPTH = "depth"
    INVERSE_DEPTH = "inverse depth"

    @property
    def shift_unit(self) -> str:
        return "m" if self is ScaleDomain.DEPTH else "1/m"

    @classmethod
    def of(cls, kind: DepthKind) -> ScaleDomain:
        return cls.INVERSE_DEPTH if kind is DepthKind.AFFINE_INVERSE_DEPTH else cls.DEPTH


@dataclass(frozen=True)
class DepthScale:
    """``scale * value + shift`` is depth in metres, or inverse depth in one over metres."""

    scale: float
    shift: float = 0.0
    domain: ScaleDomain = ScaleDomain.DEPTH

    def depth_m(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """``(H, W)`` values of a model as metres, 0 where unknown or not before the camera."""
        known = np.isfinite(values) & (values != 0)
        line = self.scale * np.asarray(values, dtype=np.float64) + self.shift
        known &= line > 1e-6
        line = np.where(known, line, 1.0)
        depth_m = line if self.domain is ScaleDomain.DEPTH else 1.0 / line
        return np.where(known, depth_m, 0.0).astype(np.float32)


@dataclass(frozen=True)
class ScaleFit:
    """A :class:`DepthScale` found against a depth sensor, and how sure it is.

    Attributes:
        sequence: its name.
        sequence_id: a hash that tells it from others of that name; empty where it is not known.
        model, kind, weights: whose predictions were compared.
        scale_sigma_log: standard error of the natural log of ``scale.scale``; of one that
            was fitted with a shift, standard error of the log of depth at the median depth
            (the two err together, and the scale alone says little). None with one frame.
        shift_sigma: standard error of the shift in its unit; None without a shift.
        frames, pixels: compared.
        frame_spread_log: standard deviation over frames of the log of the factor that each
            would want beyond the common fit: how steady the model is from frame to frame.
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
    """True for predictions that a factor alone does not make metric."""
    return kind is not DepthKind.METRIC


def fit_scale(
    model: DepthModel, frames: Iterable[Frame], *, with_shift: bool, sequence: str, sequence_id: str = ""
) -> ScaleFit:
    """Compare the model's predictions with the sensor's depth of ``frames``, in order of time.

    The scale alone is the median over frames of each frame's median ratio, so that a frame
    counts once however many pixels its sensor saw. With a shift a line is fitted robustly
    to all pixels. Uncertainties are a bootstrap over blocks of frames, since the pixels of a
    frame err together, and so do neighbouring frames.

    Raises:
        ConfigError: a relative model without a shift, or a model that is the sensor itself.
        DatasetError: no frame can be compared, or the predictions do not follow the depth.
    """
    check_can_fit(model, with_shift)
    values, sensor_m = _samples(model, frames)
    if not values:
        raise DatasetError(f"{sequence}: no frame has sensor depth to fit the scale of '{model.name}' to")
    domain = ScaleDomain.of(model.kind)
    rows = block_resamples(len(values), resamples=_RESAMPLES) if len(values) > 1 else None
    if with_shift:
        scale, sigma_log, shift_sigma = _fit_line(values, sensor_m, domain, rows, model.name)
    else:
        each = np.array([float(np.median(np.log(s / v))) for v, s in zip(values, sensor_m, strict=True)])
        scale = DepthScale(float(np.exp(np.median(each))), 0.0, domain)
        sigma_log = None if rows is None else float(np.std(np.median(each[rows], axis=1)))
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
    """Raise ConfigError where a fit of this model would mean nothing; see :func:`fit_scale`."""
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
        if np.count_nonzero(both) >= _FEWEST_PIXELS:
            values.append(value[both])
            sensor_m.append(measured[both])
    return values, sensor_m


def _fit_line(
    values: list[Floats],
    sensor_m: list[Floats],
    domain: ScaleDomain,
    rows: NDArray[np.int64] | None,
    name: str,
) -> tuple[DepthScale, float | None, float | None]:
    each = max(_FEWEST_PIXELS, _MOST_SAMPLES // len(values))
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
    if rows is None:
        return scale, None, None
    lines = []
    for row in rows:
        resampled = np.concatenate([x[i] for i in row]), np.concatenate([y[i] for i in row])
        lines.append(robust_line(*resampled, start=(slope, intercept), spread=spread)[:2])
    slopes, intercepts = np.array(lines).T
    middle = float(np.median(np.concatenate(x)))
    at_middle = np.maximum(slopes * middle + intercepts, 1e-9)
    return scale, float(np.std(np.log(at_middle))), float(np.std(intercepts))


def _frame_spread(scale: DepthScale, values: list[Floats], sensor_m: list[Floats]) -> float:
    wanted = []
    for value, measured in zip(values, sensor_m, strict=True):
        depth_m = scale.depth_m(value)
        if (known := depth_m > 0).any():
            wanted.append(float(np.median(np.log(measured[known] / depth_m[known]))))
    return float(np.std(wanted)) if wanted else 0.0
