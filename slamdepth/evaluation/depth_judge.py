# SPDX-License-Identifier: Apache-2.0
"""Full evaluation of a depth model against a sensor, for ``eval-depth``: scaled four ways, with intervals.

Edges, structure and the affine fit need whole maps, intervals need the figures of every frame.
:mod:`slamdepth.evaluation.depth` is the short score for the report of a run, of the same pixels and errors.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from slamdepth.evaluation.bootstrap import Interval, interval, spread
from slamdepth.evaluation.calibration import Coverage, coverage_of, observed
from slamdepth.evaluation.depth import depth_errors
from slamdepth.evaluation.depth_fit import affine_fit, apply_affine, fits_in
from slamdepth.evaluation.depth_maps import EdgeScore, depth_ssim, edge_score
from slamdepth.evaluation.depth_pixels import MAX_M, MIN_M, STRIDE, ComparedPixels, as_depth
from slamdepth.types import DepthKind, DepthPrediction
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray


WAYS = ("as_predicted", "sequence_median", "frame_median", "frame_affine")
FIGURES = (
    "abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3", "ssim", "edge_f1", "edge_error_px",
)  # fmt: skip
BINS = 24
_IN_MEMORY_BYTES = 2**28
_NO_EDGES = EdgeScore(math.nan, math.nan)


@dataclass(frozen=True)
class OverDepth:
    """Errors by the sensor's depth; over all pixels of all frames.

    Attributes:
        edges_m: ``BINS + 1`` bounds of the bins, evenly spaced in log depth.
        pixels: pixels in each bin.
        abs_rel: way of scaling to the mean AbsRel in each bin, None where it is empty.
        log_bias: way of scaling to the mean natural logarithm of predicted / sensor in each bin.
    """

    edges_m: tuple[float, ...]
    pixels: tuple[int, ...]
    abs_rel: dict[str, tuple[float | None, ...]]
    log_bias: dict[str, tuple[float | None, ...]]


@dataclass(frozen=True)
class DepthJudgement:
    """Accuracy of predicted depth. Figures are means over frames, with 95 % intervals.

    Attributes:
        kind: what the model's numbers mean.
        ways: way of scaling, of :data:`WAYS`, to figure, of :data:`FIGURES`, to its value.
            Without ``as_predicted`` where the model is not metric. ``abs_rel``, ``rmse_m``
            (metres), ``log_rmse``, ``delta1`` to ``delta3``: see
            :class:`~slamdepth.evaluation.depth.DepthErrors`; ``ssim``, ``edge_f1``,
            ``edge_error_px``: see :mod:`slamdepth.evaluation.depth_maps`.
        fitted_in: what ``frame_affine`` is linear in.
        sequence_factor: the one factor of ``sequence_median``: median of sensor / predicted.
        scale_spread: standard deviation over the frames of the log of the frame's factor.
        surest_half: AbsRel of the half of each frame's pixels with the smaller sigma over that of all
            of them, after scaling by the frame's median; 1 where sigma is uninformative. None without sigma.
        within_one_sigma: share of pixels whose log error, as predicted, is below sigma; 0.68
            where sigma is calibrated. None without sigma or metres.
        pixel_coverage: calibration curve of sigma, after scaling by the frame's median; each frame counts
            the same. None without sigma.
        scale_coverage: calibration curve of the scale of an image. None where the model does not say how
            sure it is of the scale, or is not metric.
        over_depth: errors by depth.
        frames: number compared. pixels: of the errors, after subsampling.
        coverage: share of the sensor's pixels that have a prediction.
        per_frame: figure, as ``way.figure``, ``log_factor`` (of ``frame_median``) or by its name
            above, to its ``frames`` values.
    """

    kind: DepthKind
    ways: dict[str, dict[str, Interval]]
    fitted_in: str
    sequence_factor: float
    scale_spread: Interval
    surest_half: Interval | None
    within_one_sigma: Interval | None
    pixel_coverage: Coverage | None
    scale_coverage: Coverage | None
    over_depth: OverDepth
    frames: int
    pixels: int
    coverage: float
    per_frame: dict[str, tuple[float, ...]]

    def to_dict(self) -> dict[str, Any]:
        """The figures as nested dicts and numbers; NaN where a frame lacks a figure."""
        return {**asdict(self), "kind": self.kind.value}


def mean_over_sets(judgements: Sequence[DepthJudgement]) -> dict[str, dict[str, float]]:
    """Unweighted means of :attr:`DepthJudgement.ways` over data sets; NaN where a set lacks the figure."""
    return {
        way: {name: float(np.mean([j.ways[way][name].value for j in judgements])) for name in FIGURES}
        for way in WAYS
        if all(way in j.ways for j in judgements)
    }


class DepthJudge:
    """Collects predictions and evaluates them at the end.

    The factor of ``sequence_median`` is known only at the end, so maps are kept in a temporary
    file, which stays in memory up to 256 MiB.

    Args:
        kind: what the predictions' numbers mean.
        min_m, max_m, stride: see :class:`~slamdepth.evaluation.depth_pixels.ComparedPixels`;
            SSIM and edges are of all pixels, whatever the stride.
    """

    def __init__(
        self, kind: DepthKind, *, min_m: float = MIN_M, max_m: float = MAX_M, stride: int = STRIDE
    ) -> None:
        self.kind = kind
        self._compared = ComparedPixels(min_m=min_m, max_m=max_m, stride=stride)
        self._waiting: IO[bytes] = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES)  # noqa: SIM115
        self._ratios: list[NDArray[np.float32]] = []
        self._uncertainties: list[dict[str, float]] = []
        self._pixel_coverages: list[Floats] = []
        self._scale_sigmas: list[float] = []

    @property
    def frames(self) -> int:
        """Frames compared so far."""
        return self._compared.frames

    def add(self, prediction: DepthPrediction, sensor_m: NDArray[np.floating]) -> bool:
        """Take in one frame.

        Args:
            prediction: its values, 0, negative or not finite where there is none.
            sensor_m: ``(H, W)`` metres of the same pixels; 0 where unknown.

        Returns:
            False where no pixel has both; such a frame is not counted.

        Raises:
            ValueError: the maps are not of one shape, or the prediction is of another kind.
        """
        if prediction.kind is not self.kind:
            raise ValueError(f"a judge of {self.kind.value} was given {prediction.kind.value}")
        found = self._compared.take(prediction.values, sensor_m, self.kind)
        if found is None:
            return False
        self._ratios.append(found.ratios.astype(np.float32))
        self._uncertainties.append({})
        if prediction.sigma_log is not None:
            error, sigma = np.log(found.depth / found.sensor_m), prediction.sigma_log[found.where]
            if len(error) >= 2:
                self._uncertainties[-1] = _uncertainty(error, sigma, self.kind is DepthKind.METRIC)
            self._pixel_coverages.append(observed(error - np.median(error), sigma.astype(np.float64)))
        if prediction.scale_sigma_log is not None:
            self._scale_sigmas.append(prediction.scale_sigma_log)
        for array in (as_depth(prediction.values, self.kind), self._compared.in_range(sensor_m)):
            np.save(self._waiting, array.astype(np.float32))
        return True

    def judge(self) -> DepthJudgement | None:
        """The figures over all frames added, or None where none could be compared."""
        if not self.frames:
            return None
        factor = float(np.median(np.concatenate(self._ratios)))
        ways = WAYS if self.kind is DepthKind.METRIC else WAYS[1:]
        rows: list[dict[str, float]] = []
        bins = _Bins(self._compared.min_m, self._compared.max_m, ways)
        self._waiting.seek(0)
        for log_factor, uncertainty in zip(self._compared.log_factors, self._uncertainties, strict=True):
            depth, sensor = (np.load(self._waiting).astype(np.float64) for _ in range(2))
            row = {"log_factor": log_factor, **uncertainty}
            edges: EdgeScore | None = None
            for way, scaled in self._scaled(depth, sensor, factor, log_factor):
                if edges is None or way == "frame_affine":  # a factor alone moves no edge
                    edges = edge_score(scaled, sensor, (scaled > 0) & (sensor > 0)) or _NO_EDGES
                figures = self._figures(scaled, sensor, edges)
                row.update({f"{way}.{name}": value for name, value in figures.items()})
                bins.add(way, scaled[self._compared.grid], sensor[self._compared.grid])
            rows.append(row)
        columns = {name: np.array([row.get(name, math.nan) for row in rows]) for name in _names(rows)}
        return DepthJudgement(
            kind=self.kind,
            ways={way: {f: interval(columns[f"{way}.{f}"]) for f in FIGURES} for way in ways},
            fitted_in=fits_in(self.kind),
            sequence_factor=factor,
            scale_spread=interval(columns["log_factor"], spread),
            surest_half=_optional(columns, "surest_half"),
            within_one_sigma=_optional(columns, "within_one_sigma"),
            pixel_coverage=self._pixel_coverage(),
            scale_coverage=self._scale_coverage(),
            over_depth=bins.result(),
            frames=self.frames,
            pixels=self._compared.pixels,
            coverage=self._compared.coverage,
            per_frame={name: tuple(column.tolist()) for name, column in columns.items()},
        )

    def _pixel_coverage(self) -> Coverage | None:
        if len(self._pixel_coverages) < self.frames:
            return None
        mean = np.mean(self._pixel_coverages, axis=0)
        return Coverage(tuple(mean.tolist()), 1.0, self._compared.pixels)

    def _scale_coverage(self) -> Coverage | None:
        if self.kind is not DepthKind.METRIC or len(self._scale_sigmas) < self.frames:
            return None
        return coverage_of(np.array(self._compared.log_factors), np.array(self._scale_sigmas))

    def _scaled(
        self, depth: Floats, sensor: Floats, factor: float, log_factor: float
    ) -> list[tuple[str, Floats]]:
        d, s = depth[self._compared.grid], sensor[self._compared.grid]
        both = (d > 0) & (s > 0)
        fit = affine_fit(d[both], s[both], self.kind)
        scaled = [
            ("sequence_median", depth * factor),
            ("frame_median", depth * math.exp(log_factor)),
            ("frame_affine", apply_affine(depth, fit, self.kind, self._compared.min_m, self._compared.max_m)),
        ]
        return [("as_predicted", depth), *scaled] if self.kind is DepthKind.METRIC else scaled

    def _figures(self, depth_m: Floats, sensor_m: Floats, edges: EdgeScore) -> dict[str, float]:
        known = (depth_m > 0) & (sensor_m > 0)
        chosen = known[self._compared.grid]
        errors = depth_errors(depth_m[self._compared.grid][chosen], sensor_m[self._compared.grid][chosen])
        return {
            **asdict(errors),
            "ssim": depth_ssim(depth_m, sensor_m, known),
            "edge_f1": edges.f1,
            "edge_error_px": edges.error_px,
        }


class _Bins:
    """Sums of errors by the sensor's depth."""

    def __init__(self, min_m: float, max_m: float, ways: tuple[str, ...]) -> None:
        self.edges = np.geomspace(min_m, max_m, BINS + 1)
        self.sums = {way: np.zeros((3, BINS)) for way in ways}

    def add(self, way: str, depth_m: Floats, sensor_m: Floats) -> None:
        both = (depth_m > 0) & (sensor_m > 0)
        d, s = depth_m[both], sensor_m[both]
        which = np.clip(np.searchsorted(self.edges, s, side="right") - 1, 0, BINS - 1)
        for row, values in enumerate((np.ones_like(d), np.abs(d - s) / s, np.log(d / s))):
            self.sums[way][row] += np.bincount(which, values, BINS)

    def result(self) -> OverDepth:
        counts = next(iter(self.sums.values()))[0]
        means = {
            way: [[float(v / n) if n else None for v, n in zip(row, counts, strict=True)] for row in sums[1:]]
            for way, sums in self.sums.items()
        }
        return OverDepth(
            edges_m=tuple(self.edges.tolist()),
            pixels=tuple(int(n) for n in counts),
            abs_rel={way: tuple(rows[0]) for way, rows in means.items()},
            log_bias={way: tuple(rows[1]) for way, rows in means.items()},
        )


def _uncertainty(error: Floats, sigma: NDArray[np.floating], is_metric: bool) -> dict[str, float]:
    scaled = np.abs(np.expm1(error - np.median(error)))
    sure = sigma <= np.median(sigma)
    known = {"surest_half": float(scaled[sure].mean() / max(float(scaled.mean()), 1e-9))}
    return {**known, "within_one_sigma": float(np.mean(np.abs(error) < sigma))} if is_metric else known


def _names(rows: list[dict[str, float]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _optional(columns: dict[str, Floats], name: str) -> Interval | None:
    return interval(columns[name]) if name in columns else None
