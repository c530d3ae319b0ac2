# SPDX-License-Identifier: Apache-2.0
"""Precision and recall of the answers to all queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Answers = Sequence[tuple[int, float]]
"""The answer to one query: earlier frames and their scores, best first."""


@dataclass(frozen=True)
class PlaceScore:
    """How good the answers of a method are.

    The first answer to a query is accepted above a threshold of its score. Precision is the share of right
    answers among the accepted; recall is the share of the queries with a known place whose accepted answer
    is right. Answers labelled -1 are ignored.

    Attributes:
        queries, known: all queries, and those whose place an earlier frame shows.
        average_precision: precision averaged over recall.
        recall_at_full_precision: recall at the lowest threshold above which no answer is wrong.
        recall_at_1, recall_at_5: share of the known queries with a right answer among the first 1 and 5.
        curve: ``(P, 2)`` recall and precision, from the highest threshold down.
    """

    queries: int
    known: int
    average_precision: float
    recall_at_full_precision: float
    recall_at_1: float
    recall_at_5: float
    curve: NDArray[np.float64]


def score_answers(
    answers: Mapping[int, Answers], labels: NDArray[np.int8], earlier: Mapping[int, Sequence[int]]
) -> PlaceScore:
    """Score the answers to all queries.

    Args:
        answers: for each query; empty where a method has none.
        labels: ``(N, N)``, 1 for one place, 0 for two, -1 for pairs that are ignored.
        earlier: the frames that each query may be answered with.
    """
    known = {q for q, frames in earlier.items() if any(labels[q, k] == 1 for k in frames)}
    ranked = {q: [(k, s) for k, s in answers[q] if labels[q, k] >= 0] for q in earlier}
    first = [(found[0][1], labels[q, found[0][0]] == 1) for q, found in ranked.items() if found]
    curve = _curve(first, len(known))
    full = curve[curve[:, 1] == 1.0, 0]
    steps = np.diff(np.concatenate([[0.0], curve[:, 0]]))

    def among(count: int) -> float:
        hits = [any(labels[q, k] == 1 for k, _ in ranked[q][:count]) for q in known]
        return float(np.mean(hits)) if hits else float("nan")

    return PlaceScore(
        queries=len(earlier),
        known=len(known),
        average_precision=float(np.sum(steps * curve[:, 1])),
        recall_at_full_precision=float(full.max()) if len(full) else 0.0,
        recall_at_1=among(1),
        recall_at_5=among(5),
        curve=curve,
    )


def _curve(first: list[tuple[float, bool]], known: int) -> NDArray[np.float64]:
    """Recall and precision at every threshold; equal scores are accepted together."""
    if not first or known == 0:
        return np.zeros((0, 2))
    score = np.array([s for s, _ in first])
    right = np.array([r for _, r in first], dtype=np.float64)
    order = np.argsort(-score, kind="stable")
    hits, accepted = np.cumsum(right[order]), np.arange(1, len(order) + 1)
    last = np.r_[np.diff(score[order]) != 0, True]
    return np.stack([hits[last] / known, hits[last] / accepted[last]], axis=1)
