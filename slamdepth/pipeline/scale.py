# SPDX-License-Identifier: Apache-2.0
"""After tracking: the final scale of each map.

The largest map may be rescaled: by what was given to scale it by (a known size, a marker, inertial data),
combined with the scale that the depth gave the map, or, where that is asked for, by the scale of the ground
truth's trajectory. Maps that never met it have no part in these: their scale is what their own depth gave
them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.errors import DatasetError
from slamdepth.fiducial import MarkerSpec
from slamdepth.io.imu import read_imu
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.options import ProgressCallback, RunProgress, RunStage
from slamdepth.pipeline.prediction_scale import PredictionScale, read_with_depth
from slamdepth.pipeline.scale_sentence import (
    NO_CLAIM,
    disagreements,
    fused_sentence,
    measured_sentence,
    multiplied_sentence,
    own_sentence,
)
from slamdepth.report import ScaleFacts, ScalePart, ScaleSource
from slamdepth.scale.camera_height import from_camera_height
from slamdepth.scale.estimate import Fused, ScaleEstimate, fused
from slamdepth.scale.imu import from_imu
from slamdepth.scale.known_size import from_baseline, from_ground_truth, from_sensor, rescaled
from slamdepth.scale.marker import from_markers
from slamdepth.scale.votes import VotedScale, judge_votes

logger = logging.getLogger(__name__)


def settle_scale(
    dataset: Dataset,
    reconstruction: Reconstruction,
    before: PredictionScale,
    config: Config,
    tell: ProgressCallback = lambda state: None,
) -> tuple[Reconstruction, ScaleFacts, tuple[str, ...]]:
    """Settle the scale of the largest map; ``others`` stay as they are.

    Args:
        reconstruction: as the tracker returned it.
        before: what was applied to the predictions it was made of.
        tell: progress, while images are searched for markers.

    Returns:
        The reconstruction at its final scale, the facts about that scale, and notes on what failed.
    """
    own = _own_scale(dataset, reconstruction, before)
    reconstruction, known, notes = _with_inertial_gravity(reconstruction, config)
    sizes, further = _known_scales(dataset, reconstruction, before, config, tell)
    known += sizes
    notes += further + own.notes
    verdict = _verdict(before, own, known)
    claim = [NO_CLAIM] if verdict.from_ground_truth else []
    sentence = "; ".join([verdict.sentence, *notes, *claim])
    if known and not before.wants_trajectory:
        notes += disagreements(own.estimate, known, verdict.fused)
    facts = _facts(before, own.voted, verdict, sentence)
    logger.info("scale: %s", sentence)
    for note in notes:
        logger.warning("%s", note)
    if verdict.estimate.factor != 1.0:
        reconstruction = rescaled(reconstruction, verdict.estimate.factor)
    return reconstruction, facts, tuple(notes)


def scale_of_other(
    dataset: Dataset, other: Reconstruction, before: PredictionScale, config: Config
) -> tuple[Reconstruction, ScaleFacts, tuple[str, ...]]:
    """Settle the scale of a map that never met the largest one, by its own depth alone.

    A factor on predictions is in its depth already. What scales the largest map says nothing of this one.

    Args:
        other: as the tracker returned it.
        before: what was applied to the predictions it was made of.

    Returns:
        The map at its final scale, the facts about that scale, and notes on what failed.
    """
    own = _own_scale(dataset, other, before)
    sentence = own.sentence
    if before.wants_trajectory or config.scale.is_known:
        sentence += "; what was given to scale the largest map by says nothing of this one"
    verdict = _Verdict(own.estimate, sentence, before.from_ground_truth)
    facts = _facts(before, own.voted, verdict, sentence)
    factor = own.estimate.factor
    return rescaled(other, factor) if factor != 1.0 else other, facts, tuple(own.notes)


@dataclass(frozen=True)
class _Own:
    """The scale that the depth gave a map."""

    estimate: ScaleEstimate
    voted: VotedScale
    sentence: str
    notes: list[str]


@dataclass(frozen=True)
class _Verdict:
    """The factor on the finished map, and what is said of it."""

    estimate: ScaleEstimate
    sentence: str
    from_ground_truth: bool
    parts: tuple[ScalePart, ...] = ()
    fused: Fused | None = None


def _facts(before: PredictionScale, voted: VotedScale, verdict: _Verdict, sentence: str) -> ScaleFacts:
    """What the report says of the scale."""
    shifted = before.scale if before.scale is not None and before.scale.shift else None
    estimate = verdict.estimate
    return ScaleFacts(
        source=estimate.source,
        factor=before.prediction_factor * estimate.factor,
        sentence=sentence,
        uncertainty_log=estimate.sigma_log if estimate.is_stated else None,
        keyframes=voted.votes,
        independent=voted.independent if voted.votes else None,
        spread=voted.spread,
        prediction_factor=before.prediction_factor,
        shift=None if shifted is None else shifted.shift,
        shift_unit=None if shifted is None else shifted.domain.shift_unit,
        is_unknown=not estimate.is_stated
        and (estimate.sigma_log is not None or estimate.source is ScaleSource.VALUE),
        from_ground_truth=verdict.from_ground_truth,
        parts=verdict.parts,
    )


def _own_scale(dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale) -> _Own:
    """The scale that the depth gave the map.

    Where this run fitted the scale to the sensor, the finished map is compared with the sensor once more.
    """
    voted = judge_votes(reconstruction)
    notes: list[str] = []
    if before.fit is not None:
        keyframes = reconstruction.keyframes
        frames = read_with_depth(dataset, [k.frame.index for k in keyframes], lambda done, total: None)
        try:
            measured = from_sensor(keyframes, frames)
            return _Own(measured, voted, measured_sentence(before, measured), notes)
        except DatasetError as error:
            notes.append(f"the map's own scale was not compared with the sensor: {error}")
    sigma_log = voted.sigma_log
    if before.source is ScaleSource.VALUE:
        sigma_log = None
    elif before.sigma_log is not None:
        sigma_log = before.sigma_log
        if voted.spread is not None:
            sigma_log = math.hypot(sigma_log, voted.spread / math.sqrt(voted.independent))
    own = ScaleEstimate(before.source, 1.0, sigma_log, before.how)
    return _Own(own, voted, own_sentence(own, voted), notes)


def _verdict(before: PredictionScale, own: _Own, known: list[ScaleEstimate]) -> _Verdict:
    """What was given is combined with the map's own scale; the ground truth's trajectory replaces it."""
    if not known:
        return _Verdict(own.estimate, own.sentence, before.from_ground_truth)
    if before.wants_trajectory:
        return _Verdict(known[0], multiplied_sentence(known[0]), True)
    together = [own.estimate, *known]
    result = fused(together)
    parts = tuple(
        ScalePart(
            estimate.source,
            before.prediction_factor * estimate.factor,
            estimate.sigma_log if estimate.is_stated else None,
            weight,
            estimate.how,
        )
        for estimate, weight in zip(together, result.weights, strict=True)
    )
    largest = max(parts, key=lambda part: part.weight).source
    estimate = ScaleEstimate(largest, result.factor, result.sigma_log, "")
    return _Verdict(estimate, fused_sentence(together, result), before.from_ground_truth, parts, result)


def _with_inertial_gravity(
    reconstruction: Reconstruction, config: Config
) -> tuple[Reconstruction, list[ScaleEstimate], list[str]]:
    """The map with gravity as inertial data tell it, what they say of the scale, and notes."""
    if config.scale.imu is None:
        return reconstruction, [], []
    imu, notes = read_imu(config.scale.imu)
    try:
        estimate, fit = from_imu(reconstruction.trajectory, imu)
    except DatasetError as error:
        return reconstruction, [], [*notes, f"no scale from the inertial data: {error}"]
    return replace(reconstruction, gravity_w=fit.gravity_w), [estimate], notes


def _known_scales(
    dataset: Dataset,
    reconstruction: Reconstruction,
    before: PredictionScale,
    config: Config,
    tell: ProgressCallback,
) -> tuple[list[ScaleEstimate], list[str]]:
    """What the sizes given say of the scale, and a note for each that says nothing."""
    scale, trajectory = config.scale, reconstruction.trajectory
    tries: list[tuple[str, Callable[[], list[ScaleEstimate]]]] = []
    if before.wants_trajectory and (truth := dataset.ground_truth) is not None:
        tries.append(("from the ground truth", lambda: [from_ground_truth(truth, trajectory)]))
    if (height_m := scale.camera_height_m) is not None:
        tries.append(("from the camera height", lambda: [from_camera_height(reconstruction, height_m)]))
    if (length_m := scale.baseline_m) is not None:
        between_s = scale.baseline_between_s
        tries.append(("from the baseline", lambda: [from_baseline(trajectory, length_m, between_s)]))

    def show(done: int, total: int) -> None:
        tell(RunProgress(RunStage.MARKERS, done, total))

    for text in scale.marker:
        find = partial(from_markers, dataset, reconstruction, MarkerSpec.parse(text), show)
        tries.append((f"from marker {text}", find))
    found: list[ScaleEstimate] = []
    notes: list[str] = []
    for name, attempt in tries:
        try:
            found += attempt()
        except DatasetError as error:
            notes.append(f"no scale {name}: {error}")
    return found, notes
