# SPDX-License-Identifier: Apache-2.0
"""After tracking: the final scale of each map, and one sentence about it.

The largest map may be rescaled: by known sizes, combined with the scale that the depth gave the map, or,
where that is asked for, by the scale of the ground truth's trajectory. Maps that never met it have no part
in these: their scale is what their own depth gave them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.errors import DatasetError
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.pipeline.known_size import (
    ScaleEstimate,
    from_baseline,
    from_camera_height,
    from_ground_truth,
    from_sensor,
    fused,
    rescaled,
)
from slamdepth.pipeline.prediction_scale import PredictionScale, read_with_depth
from slamdepth.report import ScaleFacts, ScalePart, ScaleSource

logger = logging.getLogger(__name__)

_NO_CLAIM = "the scale was taken from ground truth: SE(3) ATE is not a metric claim"


def settle_scale(
    dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale, config: Config
) -> tuple[Reconstruction, ScaleFacts, tuple[str, ...]]:
    """Settle the scale of the largest map; ``others`` stay as they are.

    Args:
        reconstruction: as the tracker returned it.
        before: what was applied to the predictions it was made of.

    Returns:
        The reconstruction at its final scale, the facts about that scale, and notes on what failed.
    """
    own, own_sentence, own_notes = _own_scale(dataset, reconstruction, before, _spread(reconstruction))
    known, notes = _known_sizes(dataset, reconstruction, before, config)
    notes += own_notes
    verdict = _verdict(before, own, own_sentence, known)
    claim = [_NO_CLAIM] if verdict.from_ground_truth else []
    sentence = "; ".join([verdict.sentence, *notes, *claim])
    if known and not before.wants_trajectory:
        notes += _disagreements(own, known)
    facts = _facts(reconstruction, before, verdict, sentence, is_known=bool(known))
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

    A factor on predictions is in its depth already. A known size and the ground truth's trajectory belong to
    the largest map.

    Args:
        other: as the tracker returned it.
        before: what was applied to the predictions it was made of.

    Returns:
        The map at its final scale, the facts about that scale, and notes on what failed.
    """
    own, sentence, notes = _own_scale(dataset, other, before, _spread(other))
    asked = (config.scale.camera_height_m, config.scale.baseline_m)
    if before.wants_trajectory or any(length_m is not None for length_m in asked):
        sentence += "; what was given to scale the largest map by says nothing of this one"
    facts = _facts(other, before, _Verdict(own, sentence, before.from_ground_truth), sentence, is_known=False)
    return rescaled(other, own.factor) if own.factor != 1.0 else other, facts, tuple(notes)


def _spread(reconstruction: Reconstruction) -> float | None:
    """Standard deviation of the keyframes' votes, None without votes."""
    votes = reconstruction.statistics.scale_votes
    return float(np.std(votes)) if votes else None


def _facts(
    reconstruction: Reconstruction,
    before: PredictionScale,
    verdict: _Verdict,
    sentence: str,
    *,
    is_known: bool,
) -> ScaleFacts:
    """What the report says of the scale.

    Args:
        reconstruction: before it was rescaled.
        is_known: a known size or the ground truth's trajectory took part.
    """
    shifted = before.scale if before.scale is not None and before.scale.shift else None
    is_unknown = before.source is ScaleSource.VALUE and not is_known
    return ScaleFacts(
        source=verdict.estimate.source,
        factor=before.prediction_factor * verdict.estimate.factor,
        sentence=sentence,
        uncertainty_log=None if is_unknown else verdict.estimate.sigma_log,
        keyframes=len(reconstruction.statistics.scale_votes),
        spread=_spread(reconstruction),
        prediction_factor=before.prediction_factor,
        shift=None if shifted is None else shifted.shift,
        shift_unit=None if shifted is None else shifted.domain.shift_unit,
        from_ground_truth=verdict.from_ground_truth,
        parts=verdict.parts,
    )


@dataclass(frozen=True)
class _Verdict:
    """The factor on the finished map, and what is said of it."""

    estimate: ScaleEstimate
    sentence: str
    from_ground_truth: bool
    parts: tuple[ScalePart, ...] = ()


def _own_scale(
    dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale, spread: float | None
) -> tuple[ScaleEstimate, str, list[str]]:
    """The scale that the depth gave the map, a sentence about it, and notes.

    Where this run fitted the scale to the sensor, the finished map is compared with the sensor once more.

    Args:
        spread: standard deviation of the keyframes' votes, None without votes.
    """
    votes = len(reconstruction.statistics.scale_votes)
    notes: list[str] = []
    if before.fit is not None:
        keyframes = reconstruction.keyframes
        frames = read_with_depth(dataset, [k.frame.index for k in keyframes], lambda done, total: None)
        try:
            measured = from_sensor(keyframes, frames)
            return measured, _measured_sentence(before, measured), notes
        except DatasetError as error:
            notes.append(f"the map's own scale was not compared with the sensor: {error}")
    sigma_log = before.sigma_log
    if spread is not None:
        sigma_log = math.hypot(sigma_log, spread / math.sqrt(votes))
    own = ScaleEstimate(before.source, 1.0, sigma_log, before.how)
    return own, _own_sentence(before, votes, spread, sigma_log), notes


def _verdict(
    before: PredictionScale, own: ScaleEstimate, own_sentence: str, known: list[ScaleEstimate]
) -> _Verdict:
    """Known sizes are combined with the map's own scale; the ground truth's trajectory replaces it."""
    if not known:
        return _Verdict(own, own_sentence, before.from_ground_truth)
    if before.wants_trajectory:
        estimate = known[0]
        sentence = (
            f"the map was multiplied by {estimate.factor:.4g} (± {100 * estimate.sigma_log:.2g} %) after "
            f"{estimate.how}"
        )
        return _Verdict(estimate, sentence, True)
    together = [own, *known]
    factor, sigma_log, weights = fused(together)
    parts = tuple(
        ScalePart(e.source, before.prediction_factor * e.factor, e.sigma_log, w)
        for e, w in zip(together, weights, strict=True)
    )
    largest = max(parts, key=lambda part: part.weight).source
    estimate = ScaleEstimate(largest, factor, sigma_log, "")
    return _Verdict(estimate, _fused_sentence(together, weights, estimate), before.from_ground_truth, parts)


def _known_sizes(
    dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale, config: Config
) -> tuple[list[ScaleEstimate], list[str]]:
    """What each known size says of the scale, and a note for each that says nothing."""
    scale, trajectory = config.scale, reconstruction.trajectory
    tries: list[tuple[str, Callable[[], ScaleEstimate]]] = []
    if before.wants_trajectory and (truth := dataset.ground_truth) is not None:
        tries.append(("from the ground truth", lambda: from_ground_truth(truth, trajectory)))
    if (height_m := scale.camera_height_m) is not None:
        reach_m = config.map.max_depth_m
        tries.append(
            (
                "from the camera height",
                lambda: from_camera_height(
                    reconstruction.keyframes, height_m, reach_m, reconstruction.gravity_w
                ),
            )
        )
    if (length_m := scale.baseline_m) is not None:
        tries.append(
            ("from the baseline", lambda: from_baseline(trajectory, length_m, scale.baseline_between_s))
        )
    found, notes = [], []
    for name, attempt in tries:
        try:
            found.append(attempt())
        except DatasetError as error:
            notes.append(f"no scale {name}: {error}")
    return found, notes


def _own_sentence(before: PredictionScale, votes: int, spread: float | None, sigma_log: float) -> str:
    if before.source is ScaleSource.SENSOR:
        return f"metric, {before.how}"
    agreed = ""
    if spread is not None:
        agreed = f", the robust centre over {votes} keyframes (their log ratios spread by {spread:.2f})"
    sure = f"true metres within about {100 * sigma_log:.0f} %"
    if before.source is ScaleSource.VALUE:
        sure = "its accuracy is unknown"
    else:
        sure += " in two of three places, an assumption"
    if before.source is ScaleSource.NETWORK:
        return f"metric as far as the {before.how} is{agreed}; no sensor measured it: {sure}"
    return f"{before.how}{agreed}: {sure}"


def _measured_sentence(before: PredictionScale, measured: ScaleEstimate) -> str:
    return (
        f"{before.how}; then the map was multiplied by {measured.factor:.4g} after {measured.how}: true "
        f"metres within about {100 * measured.sigma_log:.0f} %, one standard error"
    )


def _fused_sentence(together: list[ScaleEstimate], weights: tuple[float, ...], result: ScaleEstimate) -> str:
    phrases = [
        f"{e.how} (factor {e.factor:.3f} ± {100 * e.sigma_log:.2g} %, weight {100 * w:.3g} %)"
        for e, w in zip(together, weights, strict=True)
    ]
    return (
        f"the map was multiplied by {result.factor:.4g} (± {100 * result.sigma_log:.2g} %), combined by "
        f"inverse variance of log scale from {'; '.join(phrases[1:])}; and {phrases[0]}"
    )


def _disagreements(own: ScaleEstimate, found: list[ScaleEstimate]) -> list[str]:
    notes = []
    for estimate in found:
        ratio = estimate.factor / own.factor
        apart = abs(math.log(ratio)) / math.hypot(own.sigma_log, estimate.sigma_log)
        if apart > 3:
            notes.append(
                f"the scale by {estimate.source.value} and that of the depth differ by a factor of "
                f"{ratio:.2f}, {apart:.1f} standard deviations: check the known size"
            )
    return notes
