# SPDX-License-Identifier: Apache-2.0
"""Whether the result of a run can be trusted, judged without ground truth.

The verdict is about the shape of the path. What is known of its scale is stated as a reason, and lowers the
verdict only where keyframes contradict one another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from slamdepth.evaluation.health_facts import HealthNumbers, RunFacts, measure_health
from slamdepth.evaluation.health_rules import RULES, WEAK, Finding, Verdict, leaps_are_judged, percent
from slamdepth.evaluation.health_spans import HealthSpan, find_spans
from slamdepth.evaluation.leaps import find_leaps, scene_distance

_GRAVITY = (Verdict.NOT_TRUSTWORTHY, Verdict.DOUBTFUL, Verdict.GOOD)


@dataclass(frozen=True)
class Health:
    """Whether a result can be trusted, where not, and why.

    Attributes:
        verdict: the worst that any rule says.
        headline: the verdict and its main reasons in one line for a layman.
        reasons: one sentence each, the gravest first.
        spans: stretches that are worth a look, in order of time.
        numbers: what the verdict rests on.
    """

    verdict: Verdict
    headline: str
    reasons: tuple[str, ...]
    spans: tuple[HealthSpan, ...]
    numbers: HealthNumbers

    def to_dict(self) -> dict[str, Any]:
        """The content of ``health`` in ``report.json``."""
        return {
            "verdict": self.verdict.value,
            "headline": self.headline,
            "reasons": list(self.reasons),
            "spans": [{**asdict(span), "kind": span.kind.value} for span in self.spans],
            "numbers": asdict(self.numbers),
        }


def judge_run(facts: RunFacts) -> Health:
    """The verdict on a run by all rules of :mod:`slamdepth.evaluation.health_rules`."""
    leaps = find_leaps(facts.trajectory, scene_distance(facts.trajectory, facts.points_w))
    spans = find_spans(facts.steps, facts.trajectory, leaps, WEAK * facts.least_inliers)
    numbers = measure_health(facts, spans, len(leaps))
    found = [finding for rule in RULES if (finding := rule(facts, numbers, spans)) is not None]
    found.sort(key=lambda finding: _GRAVITY.index(finding.level))
    verdict = found[0].level if found else Verdict.GOOD
    return Health(
        verdict,
        _headline(facts, numbers, verdict, found),
        tuple(finding.sentence for finding in found),
        spans,
        numbers,
    )


def _headline(facts: RunFacts, numbers: HealthNumbers, verdict: Verdict, found: Sequence[Finding]) -> str:
    if verdict is Verdict.GOOD:
        run = facts.statistics
        leaps = "without leaps" if leaps_are_judged(numbers) else "leaps were not judged"
        if run.tracked == run.frames:
            return f"Reliable: every frame was tracked ({run.frames} of {run.frames}), {leaps}."
        longest_s = math.ceil(10 * numbers.longest_loss_s) / 10
        lost = f"; no loss over {longest_s:.1f} s" if longest_s else ""
        return f"Reliable: {percent(numbers.tracked_share or 0.0)} of the frames were tracked, {leaps}{lost}."
    start = "Do not trust this result" if verdict is Verdict.NOT_TRUSTWORTHY else "Check this result"
    return f"{start}: {', '.join(finding.short for finding in found if finding.level is not Verdict.GOOD)}."
