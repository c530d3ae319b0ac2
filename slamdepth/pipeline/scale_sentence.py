# SPDX-License-Identifier: Apache-2.0
"""What is said of the scale of a map, for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from slamdepth.pipeline.prediction_scale import PredictionScale
from slamdepth.report import ScaleSource
from slamdepth.report.scale import accuracy_text
from slamdepth.scale.estimate import AGREE, Fused, ScaleEstimate, apart
from slamdepth.scale.votes import VotedScale

NO_CLAIM = "the scale was taken from ground truth: SE(3) ATE is not a metric claim"
UNKNOWN = (
    "scale unknown: this does not look like anything the depth model knows; give --depth NAME, --marker, "
    "--camera-height or --baseline-m"
)


def own_sentence(own: ScaleEstimate, voted: VotedScale) -> str:
    """The scale that the depth gave the map, and how sure it is."""
    if own.source is ScaleSource.SENSOR:
        return f"metric, {own.how}"
    if own.sigma_log is not None and math.isinf(own.sigma_log):
        return UNKNOWN
    agreed = ""
    if voted.spread is not None:
        agreed = (
            f", the robust centre over {voted.votes} keyframes (their log ratios spread by "
            f"{voted.spread:.2f}, about {voted.independent:.0f} of them independent"
        )
        if voted.drift is not None:
            agreed += f"; from first to last they drift by a factor of {math.exp(voted.drift):.2f}"
        agreed += ")"
    if own.sigma_log is not None:
        sure = accuracy_text(own.sigma_log)
    elif own.source is ScaleSource.VALUE:
        sure = "its accuracy is unknown"
    else:
        sure = "its accuracy is unknown, since the depth model states none"
    if own.source is ScaleSource.NETWORK:
        return f"metric as far as the {own.how} is{agreed}; no sensor measured it: {sure}"
    return f"{own.how}{agreed}: {sure}"


def measured_sentence(before: PredictionScale, measured: ScaleEstimate) -> str:
    """A scale that was compared with the sensor after the run."""
    return f"{before.how}; then {multiplied_sentence(measured)}"


def multiplied_sentence(estimate: ScaleEstimate) -> str:
    """A factor on the finished map, and what it comes from."""
    assert estimate.sigma_log is not None
    return (
        f"the map was multiplied by {estimate.factor:.4g} after {estimate.how}: "
        f"{accuracy_text(estimate.sigma_log)}"
    )


def fused_sentence(together: Sequence[ScaleEstimate], result: Fused) -> str:
    """Several estimates, the first of which is the map's own, and their combination."""
    phrases = [_part(estimate, weight) for estimate, weight in zip(together, result.weights, strict=True)]
    how = "by inverse variance of log scale"
    if result.contradict:
        how += ", although they contradict each other"
    return (
        f"the map was multiplied by {result.factor:.4g}: {accuracy_text(result.sigma_log)}; combined {how} "
        f"from {'; '.join(phrases[1:])}; and {phrases[0]}"
    )


def _part(estimate: ScaleEstimate, weight: float) -> str:
    sure = "accuracy unknown"
    if estimate.is_stated and estimate.sigma_log is not None:
        sure = f"± {100 * estimate.sigma_log:.2g} %"
    share = f"weight {100 * weight:.3g} %" if weight > 0 else "left out"
    return f"{estimate.how} (factor {estimate.factor:.3f}, {sure}, {share})"


def disagreements(own: ScaleEstimate, known: Sequence[ScaleEstimate], result: Fused | None) -> list[str]:
    """A note for each estimate that is far from another: which were left out, or that none could be."""
    notes = []
    weights = (0.0,) * (1 + len(known)) if result is None else result.weights
    for n, estimate in enumerate(known, start=1):
        against = own if own.is_stated else None
        left_out = weights[n] == 0.0
        if left_out and result is not None:
            ratio = estimate.factor / result.factor
            notes.append(
                f"the scale by {estimate.source.value} was left out: the others agree on one that differs "
                f"from it by a factor of {ratio:.2f}"
            )
        elif against is not None and (far := apart(estimate, against)) > AGREE:
            ratio = estimate.factor / own.factor
            notes.append(
                f"the scale by {estimate.source.value} and that of the depth differ by a factor of "
                f"{ratio:.2f}, {far:.1f} standard deviations: check what was given"
            )
    if result is not None and result.contradict:
        pairs = zip(known, weights[1:], strict=True)
        named = ", ".join(f"{e.source.value} {e.factor:.3g}" for e, w in pairs if w > 0)
        notes.append(f"the scales contradict each other ({named}): one of them is wrong, or the map drifts")
    return notes
