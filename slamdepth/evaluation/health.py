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

from slamdepth.evaluation.health_facts import RunFacts
from slamdepth.evaluation.health_numbers import HealthNumbers, measure_health
from slamdepth.evaluation.health_rules import RULES, WEAK, Finding, Verdict, leaps_are_judged, percent
from slamdepth.evaluation.health_spans import HealthSpan, find_good_spans, find_spans
from slamdepth.evaluation.leaps import find_leaps, scene_distance

_GRAVITY = (Verdict.NOT_TRUSTWORTHY, Verdict.DOUBTFUL, Verdict.GOOD)


@dataclass(frozen=True)
class Judgement:
    """Whether a path can be trusted, where not, and why.

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
        """All of it as plain values."""
        return {
            "verdict": self.verdict.value,
            "headline": self.headline,
            "reasons": list(self.reasons),
            "spans": [{**asdict(span), "kind": span.kind.value} for span in self.spans],
            "numbers": asdict(self.numbers),
        }


@dataclass(frozen=True)
class MapHealth(Judgement):
    """Whether one map can be trusted, from its first frame to its last, apart from the others.

    Attributes:
        good_spans_s: stretches of at least five seconds that are called good: from and to, seconds since the
            first frame of the run.
    """

    good_spans_s: tuple[tuple[float, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """All of it as plain values."""
        return {**super().to_dict(), "good_spans_s": [list(span) for span in self.good_spans_s]}


@dataclass(frozen=True)
class Health(Judgement):
    """Whether a result can be trusted: its largest map, given what the whole recording shows.

    Attributes:
        maps: the same of each map by itself, the largest first.
    """

    maps: tuple[MapHealth, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The content of ``health`` in ``report.json``."""
        return {**super().to_dict(), "maps": [one.to_dict() for one in self.maps]}


def judge_run(facts: RunFacts) -> Health:
    """The verdict on a run by all rules of :mod:`slamdepth.evaluation.health_rules`."""
    judgement, _ = _judge(facts)
    return Health(**vars(judgement), maps=tuple(_judge_map(one) for one in facts.of_each_map()))


def _judge_map(facts: RunFacts) -> MapHealth:
    judgement, is_doubted_everywhere = _judge(facts)
    good = () if is_doubted_everywhere else find_good_spans(facts, judgement.spans)
    return MapHealth(**vars(judgement), good_spans_s=good)


def _judge(facts: RunFacts) -> tuple[Judgement, bool]:
    """The verdict, and whether a reason against it concerns more than the spans."""
    leaps = find_leaps(facts.trajectory, scene_distance(facts.trajectory, facts.points_w))
    spans = find_spans(facts, leaps, WEAK * facts.least_inliers)
    numbers = measure_health(facts, spans, len(leaps))
    found = [finding for rule in RULES if (finding := rule(facts, numbers, spans)) is not None]
    found.sort(key=lambda finding: _GRAVITY.index(finding.level))
    verdict = found[0].level if found else Verdict.GOOD
    judgement = Judgement(
        verdict,
        _headline(facts, numbers, verdict, found),
        tuple(finding.sentence for finding in found),
        spans,
        numbers,
    )
    return judgement, any(not one.is_local and one.level is not Verdict.GOOD for one in found)


def _headline(facts: RunFacts, numbers: HealthNumbers, verdict: Verdict, found: Sequence[Finding]) -> str:
    if verdict is not Verdict.GOOD:
        start = "Do not trust this result" if verdict is Verdict.NOT_TRUSTWORTHY else "Check this result"
        return (
            f"{start}: {', '.join(finding.short for finding in found if finding.level is not Verdict.GOOD)}."
        )
    run = facts.statistics
    leaps = "without leaps" if leaps_are_judged(numbers) else "leaps were not judged"
    if run.tracked == run.frames:
        return f"Reliable: every frame was tracked ({run.frames} of {run.frames}), {leaps}."
    longest_s = math.ceil(10 * numbers.longest_loss_s) / 10
    lost = f"; no loss over {longest_s:.1f} s" if longest_s else ""
    share = percent(numbers.tracked_share or 0.0)
    if facts.others:
        return f"Reliable: {share} of the frames are in the largest of {numbers.maps} maps, {leaps}{lost}."
    return f"Reliable: {share} of the frames were tracked, {leaps}{lost}."
