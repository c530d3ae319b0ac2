# SPDX-License-Identifier: Apache-2.0
"""The camera of a recording that does not tell its intrinsics, found from the motion.

Before the run proper, short windows of the recording are tracked with the camera as it is known so far, and
the adjustment of what was seen (:mod:`slamdepth.backend.self_calibration`) gives the next one, until it
settles: what a tracker accepts with a wrong camera agrees with that camera, so that one window is not
enough. Where all of them started from much the same focal length, one starts far off: a guess that is found
again may be right, or only believed (:mod:`slamdepth.backend.self_calibration_passes`). The map of the whole
run is looked at once more at the end.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slamdepth.backend.self_calibration import Prior, SelfCalibration, self_calibrate
from slamdepth.backend.self_calibration_passes import FocalLength, Pass, focal_length_of
from slamdepth.backend.sights import Sights
from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.datasets.intrinsics import CameraSource, Certainty, camera_of_view, tell_guess
from slamdepth.datasets.virtual_view import ViewedSequence
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.errors import CameraError, ImageDecodeError
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.report import CameraFacts
from slamdepth.types import Camera

logger = logging.getLogger(__name__)

GUESSED_SIGMA = 0.35
"""Deviation of the logarithm of a guessed focal length: cameras see from about 35 to 95 degrees."""

WINDOW = 150
"""Frames of a window: the first seconds of a video."""

_PLACES = (0.0, 0.5, 0.25, 0.75, 0.0)  # of the windows, as shares of what is left of the recording
_FEWEST_PASSES = 2
_SETTLED = 0.01  # change of log f between two passes
_SURE = 0.03  # deviation of log f after which further windows are not worth their time
_SAME_CAMERA = 0.03  # windows tracked with a camera farther off say little
_OBSERVED = 0.1  # a larger deviation of log f is no measurement
_TOLD = 0.7  # of the deviation without the motion: one that is hardly smaller is not the motion's
_MODEL_SIGMA = 0.02  # of log f: what the lens model is off, which is the same in all windows of a recording
_READOUT_SIGMA_S = 0.01


@dataclass(frozen=True)
class OpeningCamera:
    """The camera before the run proper.

    Attributes:
        source: where the first guess comes from.
        prior: what is known without the motion; None where the camera is not looked for.
        sigma_log_f: deviation of the logarithm of the focal length; None where the camera was given.
        passes: what each window said.
    """

    source: CameraSource
    prior: Prior | None = None
    sigma_log_f: float | None = None
    passes: tuple[Pass, ...] = ()


@dataclass(frozen=True)
class _Window:
    """What was seen with a camera, and the camera that it shows, whatever focal length was named."""

    sights: Sights
    tracked: Camera
    found: SelfCalibration

    @staticmethod
    def of(sights: Sights, tracked: Camera, prior: Prior) -> _Window:
        return _Window(sights, tracked, self_calibrate(sights, tracked, _unnamed(prior)))

    @property
    def said(self) -> Pass:
        found = self.found
        return Pass(math.log(self.tracked.fx), math.log(found.camera.fx), found.sigma_log_f)

    def with_named(self, prior: Prior) -> SelfCalibration:
        """The camera by what was seen and by the focal length that was named."""
        is_the_same = prior == _unnamed(prior)
        return self.found if is_the_same else self_calibrate(self.sights, self.tracked, prior)


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
    tell_guess(dataset.path.name, source)
    if config.odometry != "orb" or dataset.is_live:
        return OpeningCamera(source, None, sigma)
    windows: list[_Window] = []
    best, opening = guess, math.inf
    for n, place in enumerate(_PLACES):
        start = round(place * max(0, len(indices) - WINDOW))
        window = indices[start : start + WINDOW]
        tell(RunProgress(RunStage.CALIBRATING, n, len(_PLACES)))
        sights = sights_of_window(dataset, window, model, config, stop)
        if stop.is_set():
            break
        if sights is None:
            continue
        windows.append(_Window.of(sights, dataset.camera, prior))
        focal = _by_passes([one.said for one in windows], prior)
        found, change = _adjusted(windows, focal, prior)
        logger.info(
            "pass %d: focal length %.1f px from %.1f px; all: %.1f px +- %.1f %%, memory %.2f; k1 %.3f",
            n + 1, math.exp(windows[-1].said.found_log_f), dataset.camera.fx, math.exp(focal.log_f),
            100 * focal.sigma, focal.memory, found.camera.distortion[0],
        )  # fmt: skip
        best, opening = found.camera, _deviation(focal, found.camera)
        dataset.camera = best
        if len(windows) >= _FEWEST_PASSES and focal.sigma < _SURE:
            if change < max(_SETTLED, found.sigma_log_f):
                break
        elif len(windows) >= _FEWEST_PASSES and _farthest(windows, best) < GUESSED_SIGMA / 2:
            dataset.camera = _too_long(best)
    said = tuple(one.said for one in windows)
    if _is_observed(opening, prior):
        dataset.camera = best
        return OpeningCamera(source, prior, opening, said)
    if stop.is_set():
        logger.info("interrupted before the focal length was found")
    else:
        logger.warning("the motion of the first windows does not show the focal length")
    dataset.camera = guess
    return OpeningCamera(source, prior, sigma, said)


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
    whole = _Window.of(sights, camera, opening.prior)
    found = whole.with_named(opening.prior)
    change = math.log(found.camera.fx / camera.fx)
    focal = _by_passes([*opening.passes, whole.said], opening.prior)
    sigma = _deviation(focal, found.camera)
    is_observed = _is_observed(sigma, opening.prior)
    logger.info(
        "final map: focal length %.1f px, tracked with %.1f px; all: %.1f px +- %.1f %%, memory %.2f",
        found.camera.fx, camera.fx, math.exp(focal.log_f), 100 * focal.sigma, focal.memory,
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


def _unnamed(prior: Prior) -> Prior:
    return replace(prior, sigma_log_f=max(prior.sigma_log_f, GUESSED_SIGMA))


def _by_passes(passes: Sequence[Pass], prior: Prior) -> FocalLength:
    return focal_length_of(passes, math.log(prior.focal_px), prior.sigma_log_f)


def _deviation(focal: FocalLength, camera: Camera) -> float:
    """Of the logarithm of a camera's focal length."""
    return math.hypot(focal.sigma, focal.log_f - math.log(camera.fx), _MODEL_SIGMA)


def _farthest(windows: Sequence[_Window], camera: Camera) -> float:
    """How far off, in log f, windows were tracked from what they say."""
    return max(abs(one.said.tracked_log_f - math.log(camera.fx)) for one in windows)


def _too_long(camera: Camera) -> Camera:
    """A camera of a focal length so much too long as a guess may be.

    From too short a one, which bends what is seen at the border, another minimum is found as often as not.
    """
    factor = math.exp(GUESSED_SIGMA)
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def _adjusted(windows: Sequence[_Window], focal: FocalLength, prior: Prior) -> tuple[SelfCalibration, float]:
    """The camera by the windows that were tracked close to what all say, and how far f has changed."""
    nearest = min(windows, key=lambda one: abs(one.said.tracked_log_f - focal.log_f))
    log_f = nearest.said.tracked_log_f
    close = [one.sights for one in windows if abs(one.said.tracked_log_f - log_f) < _SAME_CAMERA]
    if len(close) == 1:
        found = nearest.with_named(prior)
    else:
        found = self_calibrate(Sights.joined(close), nearest.tracked, prior)
    return found, abs(math.log(found.camera.fx) - log_f)


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
