# SPDX-License-Identifier: Apache-2.0
"""The short score of depth maps against a sensor's, for the report of a run: errors, scaled three ways.

It is computed frame by frame in bounded memory. :mod:`slamdepth.evaluation.depth_judge` adds measures of
whole maps and confidence intervals, of the same pixels and errors.

Each figure is computed inside a frame and then averaged over the frames, so that frames weigh
alike however many of their pixels the sensor saw. The measures are those of
Eigen, Puhrsch and Fergus, "Depth map prediction from a single image using a multi-scale
deep network", NIPS 2014. Nothing is clamped.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.evaluation.depth_pixels import MAX_M, MIN_M, STRIDE, ComparedPixels
from slamdepth.types import DepthKind
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray


_DELTA = 1.25


@dataclass(frozen=True)
class DepthErrors:
    """Errors of depth maps, each the mean over frames of the frame's figure.

    Attributes:
        abs_rel: mean of ``|predicted - sensor| / sensor``.
        rmse_m: root mean square of the difference in metres.
        log_rmse: root mean square of the difference of natural logarithms.
        delta1, delta2, delta3: share of pixels whose ratio to the sensor, either way
            round, is below 1.25, 1.25^2 and 1.25^3.
    """

    abs_rel: float
    rmse_m: float
    log_rmse: float
    delta1: float
    delta2: float
    delta3: float


@dataclass(frozen=True)
class DepthScore:
    """Accuracy of the depth of a sequence, scaled three ways.

    Attributes:
        metric: as predicted.
        sequence_median: after one factor for the whole sequence, the median of
            sensor / predicted over all pixels.
        frame_median: after such a factor for each frame.
        sequence_scale: the factor of ``sequence_median``.
        frame_scale_spread: standard deviation over the frames of the natural logarithm
            of the frame's factor: about the relative wobble of scale from frame to frame.
        frames, pixels: number compared (pixels after subsampling).
        coverage: share of the sensor's valid pixels that have a prediction.
    """

    metric: DepthErrors
    sequence_median: DepthErrors
    frame_median: DepthErrors
    sequence_scale: float
    frame_scale_spread: float
    frames: int
    pixels: int
    coverage: float

    def to_dict(self) -> dict[str, Any]:
        """The figures as nested dicts of numbers."""
        return asdict(self)


class DepthScorer:
    """Collects frames and scores them at the end.

    The factor of ``sequence_median`` is known only at the end, so samples are kept as
    float32 pairs. When there are more than ``max_samples``, every second one of each frame
    is dropped and later frames are thinned alike; the other figures use every sample.

    Args:
        min_m, max_m, stride: see :class:`~slamdepth.evaluation.depth_pixels.ComparedPixels`.
        max_samples: upper bound of samples kept.
    """

    def __init__(
        self,
        *,
        min_m: float = MIN_M,
        max_m: float = MAX_M,
        stride: int = STRIDE,
        max_samples: int = 4_000_000,
    ) -> None:
        if max_samples < 1:
            raise ValueError(f"max_samples must be positive, got {max_samples}")
        self.max_samples = max_samples
        self._compared = ComparedPixels(min_m=min_m, max_m=max_m, stride=stride)
        self._samples: list[tuple[Floats32, Floats32]] = []
        self._kept = 0
        self._thinning = 1
        self._metric: list[DepthErrors] = []
        self._frame_median: list[DepthErrors] = []

    @property
    def frames(self) -> int:
        """Frames compared so far."""
        return self._compared.frames

    def add(self, predicted_m: NDArray[np.floating], sensor_m: NDArray[np.floating]) -> bool:
        """Compare one frame.

        Args:
            predicted_m: ``(H, W)`` metres; pixels that are 0, negative or not finite have
                no prediction and only lower ``coverage``.
            sensor_m: ``(H, W)`` metres of the same pixels; 0 where unknown.

        Returns:
            False where no pixel has both; such a frame is not counted.

        Raises:
            ValueError: the two are not maps of one shape.
        """
        found = self._compared.take(predicted_m, sensor_m, DepthKind.METRIC)
        if found is None:
            return False
        self._metric.append(depth_errors(found.depth, found.sensor_m))
        self._frame_median.append(depth_errors(found.depth * found.factor, found.sensor_m))
        self._keep(found.depth.astype(np.float32), found.sensor_m.astype(np.float32))
        return True

    def score(self) -> DepthScore | None:
        """The figures over all frames added, or None where none could be compared."""
        if not self.frames:
            return None
        ratios = np.concatenate([sensor / predicted for predicted, sensor in self._samples])
        scale = float(np.median(ratios))
        scaled = [depth_errors(p * np.float32(scale), s) for p, s in self._samples]
        return DepthScore(
            metric=_mean(self._metric),
            sequence_median=_mean(scaled),
            frame_median=_mean(self._frame_median),
            sequence_scale=scale,
            frame_scale_spread=float(np.std(self._compared.log_factors)),
            frames=self.frames,
            pixels=self._compared.pixels,
            coverage=self._compared.coverage,
        )

    def _keep(self, predicted: Floats32, sensor: Floats32) -> None:
        kept = (predicted[:: self._thinning].copy(), sensor[:: self._thinning].copy())
        self._samples.append(kept)
        self._kept += len(kept[0])
        while self._kept > max(self.max_samples, len(self._samples)):
            self._thinning *= 2
            self._samples = [(p[::2].copy(), s[::2].copy()) for p, s in self._samples]
            self._kept = sum(len(p) for p, _ in self._samples)


def depth_errors(predicted_m: NDArray[np.floating], sensor_m: NDArray[np.floating]) -> DepthErrors:
    """Errors over ``(N,)`` positive depths of the same pixels, in metres."""
    predicted = np.asarray(predicted_m, dtype=np.float64)
    sensor = np.asarray(sensor_m, dtype=np.float64)
    difference = predicted - sensor
    ratio = np.maximum(predicted / sensor, sensor / predicted)
    return DepthErrors(
        abs_rel=float(np.mean(np.abs(difference) / sensor)),
        rmse_m=float(np.sqrt(np.mean(difference**2))),
        log_rmse=float(np.sqrt(np.mean(np.log(ratio) ** 2))),
        delta1=float(np.mean(ratio < _DELTA)),
        delta2=float(np.mean(ratio < _DELTA**2)),
        delta3=float(np.mean(ratio < _DELTA**3)),
    )


def _mean(errors: list[DepthErrors]) -> DepthErrors:
    names = DepthErrors.__dataclass_fields__
    return DepthErrors(**{name: float(np.mean([getattr(e, name) for e in errors])) for name in names})
