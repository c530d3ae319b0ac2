# SPDX-License-Identifier: Apache-2.0
"""Before tracking: the factor (and shift) that is applied to every prediction.

It is a number, comes from a file of ``slamdepth scale``, or is fitted to this sequence's own sensor.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamdepth.config import GROUND_TRUTH, Config
from slamdepth.datasets import Dataset
from slamdepth.datasets.sensor_depth import check_sensor_depth
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit, fit_scale, needs_shift
from slamdepth.depth.scale_file import check_same_model, read_scale
from slamdepth.depth.scaled import ScaledDepth
from slamdepth.errors import ConfigError, DatasetError, ImageDecodeError
from slamdepth.io.imu import read_imu
from slamdepth.pipeline.options import RunInterrupted
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.report import ScaleSource
from slamdepth.scale.known_size import SENSOR_SIGMA_LOG
from slamdepth.types import Frame

logger = logging.getLogger(__name__)

MAP_SIGMA_LOG = 0.12
"""Assumed standard deviation of the log ratio of a map's scale and that of all pixels of its predictions:
points lie where there is texture. On fr1_rpy and fr1_desk the two differ by a tenth."""

_FIT_FRAMES = 60


@dataclass(frozen=True)
class PredictionScale:
    """What was decided before tracking.

    Attributes:
        source: where the scale comes from; NETWORK or SENSOR where predictions stay as they are.
        how: the same as a phrase.
        sigma_log: standard deviation of the log of the resulting scale of the map; None where only the depth
            model can say.
        scale: what is applied to predictions, or None.
        from_ground_truth: True where the scale comes from this sequence's own sensor.
        fit: the fit, where this run made one.
        wants_trajectory: True where the scale is to be taken from the ground truth's trajectory afterwards.
    """

    source: ScaleSource
    how: str
    sigma_log: float | None
    scale: DepthScale | None = None
    from_ground_truth: bool = False
    fit: ScaleFit | None = None
    wants_trajectory: bool = False

    @property
    def prediction_factor(self) -> float:
        """What predictions are multiplied by as they come."""
        return 1.0 if self.scale is None else self.scale.scale

    def applied_to(self, model: DepthModel) -> DepthModel:
        """``model``, with its predictions scaled where that was decided.

        Raises:
            ConfigError: this scale cannot make this model metric.
        """
        return model if self.scale is None else ScaledDepth(model, self.scale)


def check_scale_options(dataset: Dataset, config: Config, indices: Sequence[int]) -> None:
    """Refuse what cannot be right, before anything is computed.

    Raises:
        ConfigError: the times of a baseline lie outside the frames.
        DatasetError: there is no ground truth to take a scale from, or the inertial data cannot be read.
    """
    scale = config.scale
    if scale.imu is not None:
        read_imu(scale.imu)
    if scale.depth == GROUND_TRUTH and not dataset.has_depth and dataset.ground_truth is None:
        raise DatasetError(
            f"{dataset.path}: has neither depth images nor a ground truth trajectory to take the scale from"
        )
    if scale.baseline_between_s is not None and dataset.is_live:
        raise ConfigError("--baseline-between: the times of a live source are not known before")
    if scale.baseline_between_s is not None and len(indices):
        first_s, last_s = (float(dataset.timestamps_s[i]) for i in (indices[0], indices[-1]))
        for time_s in scale.baseline_between_s:
            if not first_s <= time_s <= last_s:
                raise ConfigError(
                    f"--baseline-between {time_s:.3f}: the frames run from {first_s:.3f} to {last_s:.3f} s"
                )


def choose_prediction_scale(
    dataset: Dataset,
    model: DepthModel,
    config: Config,
    indices: Sequence[int],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    stop: threading.Event | None = None,
) -> PredictionScale:
    """Decide what is applied to predictions, and fit it where that is asked for.

    Args:
        model: as it came, not scaled.
        indices: frames of the run; a fit takes some of them.
        progress: called with the frames read so far and in all, while a scale is fitted.
        stop: set it to give up.

    Raises:
        ConfigError: the file or number cannot scale this model, or its depth is measured.
        DatasetError: no scale can be fitted.
        RunInterrupted: ``stop`` was set before the fit was done.
    """
    asked = config.scale.depth
    name = model.name
    if is_sensor(model):
        if asked is not None:
            raise ConfigError(f"--depth {name} is in metres already; --depth-scale is for predicted depth")
        return PredictionScale(ScaleSource.SENSOR, "measured by the depth sensor", SENSOR_SIGMA_LOG)
    if asked is None:
        return PredictionScale(ScaleSource.NETWORK, f"depth predicted by {name}", None)
    if asked == GROUND_TRUTH:
        if not dataset.has_depth:
            how = f"depth predicted by {name}"
            return PredictionScale(ScaleSource.NETWORK, how, None, wants_trajectory=True)
        chosen = indices[:: -(-len(indices) // _FIT_FRAMES)]
        frames = read_with_depth(dataset, chosen, progress, stop)
        fit = fit_scale(
            model,
            frames,
            with_shift=needs_shift(model.kind),
            sequence=dataset.name,
            sequence_id=sequence_id(dataset),
        )
        how = (
            f"{_formula(name, fit.scale)}, fitted to {fit.frames} frames of this sequence's own depth sensor"
        )
        return _of_fit(ScaleSource.GROUND_TRUTH_DEPTH, fit, how, own=True)
    if isinstance(asked, float | int):
        scale = DepthScale(float(asked), 0.0, ScaleDomain.of(model.kind))
        how = f"{_formula(name, scale)}, a number given by the user"
        return PredictionScale(ScaleSource.VALUE, how, None, scale=scale)
    fit = read_scale(asked)
    check_same_model(fit, model, asked)
    is_own = fit.sequence_id == sequence_id(dataset)
    of = "this very sequence" if is_own else f"{fit.sequence}, another sequence"
    how = f"{_formula(name, fit.scale)}, from {Path(asked).name}, fitted to the depth sensor of {of}"
    return _of_fit(ScaleSource.FILE, fit, how, own=is_own)


def _of_fit(source: ScaleSource, fit: ScaleFit, how: str, *, own: bool) -> PredictionScale:
    sigma_log = None
    if own and fit.scale_sigma_log is not None:
        sigma_log = math.hypot(fit.scale_sigma_log, MAP_SIGMA_LOG)
    return PredictionScale(
        source, how, sigma_log, fit.scale, own, None if source is ScaleSource.FILE else fit
    )


def _formula(name: str, scale: DepthScale) -> str:
    shift = f" {scale.shift:+.3g} {scale.domain.shift_unit}" if scale.shift else ""
    domain = f" as {scale.domain.value}" if shift else ""
    return f"depth predicted by {name} times {scale.scale:.4g}{shift}{domain}"


def read_with_depth(
    dataset: Dataset,
    indices: Sequence[int],
    progress: Callable[[int, int], None],
    stop: threading.Event | None = None,
) -> Iterator[Frame]:
    """Frames with their sensor depth; those that do not decode are left out with a warning.

    Args:
        progress: called with the frames read so far and in all.

    Raises:
        DatasetError: the depth images cannot be a sensor's.
        RunInterrupted: ``stop`` was set.
    """
    for note in check_sensor_depth(dataset, indices):
        logger.warning("%s", note)
    for done, index in enumerate(indices):
        progress(done, len(indices))
        if stop is not None and stop.is_set():
            raise RunInterrupted("interrupted while the scale was fitted; nothing was saved")
        try:
            yield dataset.read(index, with_depth=True)
        except ImageDecodeError as error:
            logger.warning("left out of the fit of the scale: %s", error)
