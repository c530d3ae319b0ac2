# SPDX-License-Identifier: Apache-2.0
"""Settled after tracking: the scale of the map, and one sentence about it.

The whole map may be multiplied, by what known sizes say or, asked for by name, by the scale
of the ground truth's trajectory. Known sizes are combined with the scale that predictions
gave the map.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

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
    """The reconstruction at its final scale, the facts about it, and notes on what failed."""
    votes = np.array(reconstruction.statistics.scale_votes)
    spread = float(np.std(votes)) if len(votes) else None
    own = ScaleEstimate(before.source, 1.0, before.sigma_log, before.how)
    if spread is not None:
        own = ScaleEstimate(
            own.source, 1.0, math.hypot(before.sigma_log, spread / math.sqrt(len(votes))), own.how
        )
    found, notes = _known_sizes(dataset, reconstruction, before, config)
    measured = None
    if before.fit is not None:
        try:
            keyframes = reconstruction.keyframes
            frames = read_with_depth(dataset, [k.frame.index for k in keyframes], lambda done, total: None)
            own = measured = from_sensor(keyframes, frames)
        except DatasetError as error:
            notes.append(f"the map's own scale was not compared with the sensor: {error}")
    prediction_factor = before.scale.scale if before.scale is not None else 1.0
    parts: tuple[ScalePart, ...] = ()
    from_ground_truth = before.from_ground_truth
    if not found:
        estimate = own
        sentence = (
            _own_sentence(before, len(votes), spread, own.sigma_log)
            if measured is None
            else _measured_sentence(before, measured)
        )
    elif before.wants_trajectory:
        estimate, from_ground_truth = found[0], True
        sentence = (
            f"the map was multiplied by {estimate.factor:.4g} (± {100 * estimate.sigma_log:.2g} %) after "
            f"{estimate.how}"
        )
    else:
        together = [own, *found]
        factor, sigma_log, weights = fused(together)
        parts = tuple(
            ScalePart(e.source, prediction_factor * e.factor, e.sigma_log, w)
            for e, w in zip(together, weights, strict=True)
        )
        largest = max(parts, key=lambda part: part.weight).source
        estimate = ScaleEstimate(largest, factor, sigma_log, "")
        sentence = _fused_sentence(together, weights, estimate)
    sentence += "".join(f"; {note}" for note in notes)
    if found and not before.wants_trajectory:
        notes += _disagreements(own, found)
    if from_ground_truth:
        sentence += f"; {_NO_CLAIM}"
    shift = before.scale.shift if before.scale is not None and before.scale.shift else None
    facts = ScaleFacts(
        source=estimate.source,
        factor=prediction_factor * estimate.factor,
        sentence=sentence,
        uncertainty_log=None if before.source is ScaleSource.VALUE and not found else estimate.sigma_log,
        keyframes=len(votes),
        spread=spread,
        prediction_factor=prediction_factor,
        shift=shift,
        shift_unit=before.scale.domain.shift_unit if before.scale is not None and shift else None,
        from_ground_truth=from_ground_truth,
        parts=parts,
    )
    logger.info("scale: %s", sentence)
    for note in notes:
        logger.warning("%s", note)
    if estimate.factor != 1.0:
        reconstruction = rescaled(reconstruction, estimate.factor)
    return reconstruction, facts, tuple(notes)


def _known_sizes(
    dataset: Dataset, reconstruction: Reconstruction, before: PredictionScale, config: Config
) -> tuple[list[ScaleEstimate], list[str]]:
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
        sure = "how true it is nobody measured"
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
    told = [
        f"{e.how} (factor {e.factor:.3f} ± {100 * e.sigma_log:.2g} %, weight {100 * w:.3g} %)"
        for e, w in zip(together, weights, strict=True)
    ]
    return (
        f"the map was multiplied by {result.factor:.4g} (± {100 * result.sigma_log:.2g} %), combined by "
        f"inverse variance of log scale from {'; '.join(told[1:])}; and {told[0]}"
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
