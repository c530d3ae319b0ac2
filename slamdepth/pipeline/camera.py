# SPDX-License-Identifier: Apache-2.0
"""The camera of a recording that does not tell its intrinsics, found from the motion.

Before the run proper, short windows of the recording are tracked with the camera as it is known so far, and
the adjustment of what was seen (:mod:`slamdepth.backend.self_calibration`) gives the next one, until it
settles: what a tracker accepts with a wrong camera agrees with that camera, so that one window is not
enough. The map of the whole run is looked at once more at the end.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamdepth.backend.self_calibration import Prior, SelfCalibration, self_calibrate
from slamdepth.backend.sights import Sights
from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, camera_of_view
from slamdepth.datasets.virtual_view import ViewedSequence
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.errors import CameraError, ImageDecodeError
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.report import CameraFacts

logger = logging.getLogger(__name__)

GUESSED_SIGMA = 0.35
"""Deviation of the logarithm of a guessed focal length: cameras see from about 35 to 95 degrees."""

WINDOW = 150
"""Frames of a window: the first seconds of a video."""

_PLACES = (0.0, 0.5, 0.25, 0.75, 0.0)  # of the windows, as shares of what is left of the recording
_FEWEST_PASSES = 2
_SETTLED = 0.01  # change of log f between two passes
_SURE = 0.02  # deviation of log f after which further windows are not worth their time
_SAME_CAMERA = 0.03  # windows tracked with a camera farther off say little
_OBSERVED = 0.1  # a larger deviation of log f is no measurement
_TOLD = 0.7  # of the deviation without the motion: one that is hardly smaller is not the motion's
_MODEL_SIGMA = 0.02  # of log f: errors of windows of seven recordings beyond what their residuals tell
_READOUT_SIGMA_S = 0.01


@dataclass(frozen=True)
class OpeningCamera:
    """The camera before the run proper.

    Attributes:
        source: where the first guess comes from.
        prior: what is known without the motion; None where the camera is not looked for.
        sigma_log_f: deviation of the logarithm of the focal length; None where the camera was given.
        scatter: deviation of log f between the windows where it did not settle, else 0: a map agrees with the
            camera it was tracked with, and cannot tell it.
    """

    source: CameraSource
    prior: Prior | None = None
    sigma_log_f: float | None = None
    scatter: float = 0.0


def use_view(dataset: Dataset, view_deg: float) -> None:
    """Give a dataset the camera that sees ``view_deg`` degrees across the longer side of its images.

    Raises:
        CameraError: no pinhole camera has such a view, or the sequence has a wide lens.
    """
    if isinstance(dataset, ViewedSequence):
        raise CameraError(f"{dataset.path}: --fov is for lenses without a model; its camera file has one")
    camera = dataset.camera
    found = camera_of_view(camera.width, camera.height, view_deg)
    dataset.camera = replace(found, depth_factor=camera.depth_factor, fps=camera.fps)
    dataset.camera_source = CameraSource(Certainty.NOMINAL, f"--fov {view_deg:g}")


def settle_camera(
    dataset: Dataset,
    indices: Sequence[int],
    model: DepthModel,
    config: Config,
    tell: ProgressCallback,
    stop: threading.Event,
) -> OpeningCamera:
    """Find the camera of a dataset whose intrinsics are not given, and let the dataset have it.

    Args:
        indices: the frames that will be tracked.
        model: where depth comes from.
    """
    source = dataset.camera_source
    if source.certainty is Certainty.GIVEN:
        return OpeningCamera(source)
    guess = dataset.camera
    prior = prior_of(guess.fx, source, config)
    sigma = prior.sigma_log_f
    logger.info("intrinsics are not given: %s", source.how)
    if config.odometry != "orb" or dataset.is_live:
        return OpeningCamera(source, None, sigma)
    passes: list[tuple[float, Sights]] = []
    settled: tuple[SelfCalibration, float] | None = None
    scatter = 0.0
    found_log_f: list[float] = []
    for n, place in enumerate(_PLACES):
        start = round(place * max(0, len(indices) - WINDOW))
        window = indices[start : start + WINDOW]
        tell(RunProgress(RunStage.CALIBRATING, n, len(_PLACES)))
        sights = sights_of_window(dataset, window, model, config, stop)
        if stop.is_set():
            break
        if sights is None:
            continue
        passes.append((math.log(dataset.camera.fx), sights))
        found, change = _adjusted(passes, dataset, prior)
        logger.info(
            "pass %d: focal length %.1f px +- %.1f %%, k1 %.3f, before %.1f px",
            n + 1, found.camera.fx, 100 * found.sigma_log_f, found.camera.distortion[0], dataset.camera.fx,
        )  # fmt: skip
        settled = (found, math.hypot(found.sigma_log_f, change, _MODEL_SIGMA))
        dataset.camera = found.camera
        found_log_f.append(math.log(found.camera.fx))
        has_settled = change < max(_SETTLED, found.sigma_log_f) and found.sigma_log_f < _SURE
        if n + 1 >= _FEWEST_PASSES and has_settled:
            scatter = 0.0
            break
        scatter = float(np.std(found_log_f))
    if settled is not None and _is_observed(opening := math.hypot(settled[1], scatter), prior):
        return OpeningCamera(source, prior, opening, scatter)
    logger.warning("the motion of the first windows does not show the focal length")
    dataset.camera = guess
    return OpeningCamera(source, prior, sigma)


def check_camera(dataset: Dataset, opening: OpeningCamera, tracker: object) -> CameraFacts:
    """The camera as the final map shows it.

    Args:
        tracker: of the run, after it has finished.
    """
    from slamdepth.tracking.tracker import sights_seen

    camera = dataset.camera
    sights = None if opening.prior is None else sights_seen(tracker)
    if opening.prior is None or sights is None:
        return CameraFacts(camera, opening.source, sigma_log_f=opening.sigma_log_f)
    found = self_calibrate(sights, camera, opening.prior)
    change = math.log(found.camera.fx / camera.fx)
    sigma = math.hypot(found.sigma_log_f, change, _MODEL_SIGMA, opening.scatter)
    is_observed = _is_observed(sigma, opening.prior)
    logger.info(
        "final map: focal length %.1f px +- %.1f %%, tracked with %.1f px",
        found.camera.fx, 100 * found.sigma_log_f, camera.fx,
    )  # fmt: skip
    if not is_observed:
        sigma = opening.prior.sigma_log_f
    facts = CameraFacts(camera, opening.source, found.camera, sigma, found.sigma_k1, is_observed)
    if is_observed and abs(change) > _SAME_CAMERA:
        dataset.notes.append(
            f"the whole recording shows a focal length of {found.camera.fx:.1f} px, its first windows "
            f"{camera.fx:.1f} px, which was used: give --fov or --camera"
        )
        logger.warning("%s", dataset.notes[-1])
    return facts


def prior_of(focal_px: float, source: CameraSource, config: Config) -> Prior:
    """What is known of a camera whose focal length was named or guessed to be ``focal_px``."""
    sigma = source.sigma_log_f if source.certainty is Certainty.NOMINAL else GUESSED_SIGMA
    readout_s = _READOUT_SIGMA_S if config.shutter.readout_ms is None else 0.0
    return Prior(focal_px, sigma, readout_s=readout_s)


def _is_observed(sigma: float, prior: Prior) -> bool:
    """Whether a deviation of log f is the motion's rather than that of what was known before."""
    return sigma < min(_OBSERVED, _TOLD * prior.sigma_log_f)


def _adjusted(
    passes: list[tuple[float, Sights]], dataset: Dataset, prior: Prior
) -> tuple[SelfCalibration, float]:
    """The camera by all windows that were tracked with one close to the latest, and how far f has changed."""
    latest = passes[-1][0]
    close = [sights for log_f, sights in passes if abs(log_f - latest) < _SAME_CAMERA]
    found = self_calibrate(Sights.joined(close), dataset.camera, prior)
    return found, abs(math.log(found.camera.fx) - latest)


def sights_of_window(
    dataset: Dataset, window: Sequence[int], model: DepthModel, config: Config, stop: threading.Event
) -> Sights | None:
    """What a tracker sees in some frames, with the dataset's camera as it is now."""
    from slamdepth.tracking.tracker import Tracker, sights_seen

    tracker = Tracker(dataset.camera, model, config)
    reader = FramePrefetcher(dataset, window, with_depth=is_sensor(model), prepare=tracker.prepare)
    with tracker:
        with reader:
            for item in reader:
                if stop.is_set():
                    return None
                if not isinstance(item, ImageDecodeError):
                    tracker.step(item.frame, item.prepared)
        return sights_seen(tracker)
