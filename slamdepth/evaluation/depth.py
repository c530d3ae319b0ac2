# SPDX-License-Identifier: Apache-2.0
"""Score depth maps against a depth sensor, frame by frame and in bounded memory.

Each figure is computed inside a frame and then averaged over the frames, so that a frame
counts the same however many of its pixels the sensor saw. The measures are those of
Eigen, Puhrsch and Fergus, "Depth map prediction from a single image using a multi-scale
deep network", NIPS 2014. Nothing is clamped.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Pixels = NDArray[np.float32]

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
    """How good the depth of a sequence is, judged three ways.

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
        """The figures as nested plain numbers."""
        return asdict(self)


class DepthAccumulator:
    """Collects frames and scores them at the end.

    The factor of ``sequence_median`` is known only at the end, so samples are kept as
    float32 pairs. When more than ``max_samples`` are held, every second one of each frame
    is dropped and later frames are thinned alike; the other figures use every sample.

    Args:
        min_m, max_m: sensor depths outside are not compared.
        stride: every ``stride``-th pixel of every ``stride``-th row is compared.
        max_samples: upper bound of samples held.
    """

    def __init__(
        self, *, min_m: float = 0.1, max_m: float = 10.0, stride: int = 4, max_samples: int = 4_000_000
    ) -> None:
        if not 0 < min_m < max_m:
            raise ValueError(f"need 0 < min_m < max_m, got {min_m} and {max_m}")
        if stride < 1 or max_samples < 1:
            raise ValueError(f"stride and max_samples must be positive, got {stride} and {max_samples}")
        self.min_m, self.max_m, self.stride, self.max_samples = min_m, max_m, stride, max_samples
        self._samples: list[tuple[Pixels, Pixels]] = []
        self._held = 0
        self._thinning = 1
        self._metric: list[DepthErrors] = []
        self._frame_median: list[DepthErrors] = []
        self._log_scales: list[float] = []
        self._pixels = 0
        self._sensor_pixels = 0

    @property
    def frames(self) -> int:
        """Frames compared so far."""
        return len(self._metric)

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
        if predicted_m.ndim != 2 or predicted_m.shape != sensor_m.shape:
            raise ValueError(
                "predicted and sensor depth must share one (H, W), "
                f"got {predicted_m.shape} and {sensor_m.shape}"
            )
        grid = slice(self.stride // 2, None, self.stride)
        predicted = np.asarray(predicted_m[grid, grid], dtype=np.float32).ravel()
        sensor = np.asarray(sensor_m[grid, grid], dtype=np.float32).ravel()
        measured = (sensor >= self.min_m) & (sensor <= self.max_m)
        both = measured & np.isfinite(predicted) & (predicted > 0)
        self._sensor_pixels += int(measured.sum())
        if not both.any():
            return False
        predicted, sensor = predicted[both], sensor[both]
        scale = float(np.median(sensor / predicted))
        self._metric.append(depth_errors(predicted, sensor))
        self._frame_median.append(depth_errors(predicted * np.float32(scale), sensor))
        self._log_scales.append(float(np.log(scale)))
        self._pixels += len(predicted)
        self._keep(predicted, sensor)
        return True

    def score(self) -> DepthScore | None:
        """The figures over all frames added, or None where none could be compared."""
        if not self._metric:
            return None
        ratios = np.concatenate([sensor / predicted for predicted, sensor in self._samples])
        scale = float(np.median(ratios))
        scaled = [depth_errors(p * np.float32(scale), s) for p, s in self._samples]
        return DepthScore(
            metric=_mean(self._metric),
            sequence_median=_mean(scaled),
            frame_median=_mean(self._frame_median),
            sequence_scale=scale,
            frame_scale_spread=float(np.std(self._log_scales)),
            frames=self.frames,
            pixels=self._pixels,
            coverage=self._pixels / self._sensor_pixels,
        )

    def _keep(self, predicted: Pixels, sensor: Pixels) -> None:
        kept = (predicted[:: self._thinning].copy(), sensor[:: self._thinning].copy())
        self._samples.append(kept)
        self._held += len(kept[0])
        while self._held > max(self.max_samples, len(self._samples)):
            self._thinning *= 2
            self._samples = [(p[::2].copy(), s[::2].copy()) for p, s in self._samples]
            self._held = sum(len(p) for p, _ in self._samples)


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
