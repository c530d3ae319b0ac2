# SPDX-License-Identifier: Apache-2.0
"""Estimates of the scale of a map, and their robust combination."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slamdepth.report import ScaleSource

AGREE = 3.0
"""Two estimates agree where their logs are within this many standard deviations of their difference."""

_PREDICTED = (ScaleSource.NETWORK, ScaleSource.FILE, ScaleSource.VALUE)


@dataclass(frozen=True)
class ScaleEstimate:
    """What the lengths of a map should be multiplied by, with its uncertainty.

    Attributes:
        source: where it comes from.
        factor: on the map's lengths.
        sigma_log: standard deviation of the natural log of ``factor``; infinite where nothing is known of
            it, None where it is not stated.
        how: what was compared, as a phrase.
    """

    source: ScaleSource
    factor: float
    sigma_log: float | None
    how: str

    @property
    def is_stated(self) -> bool:
        """Whether it has a finite uncertainty, so that it can be weighed against others."""
        return self.sigma_log is not None and math.isfinite(self.sigma_log)

    @property
    def is_measured(self) -> bool:
        """Whether a length was measured, rather than predicted by a network."""
        return self.source not in _PREDICTED


@dataclass(frozen=True)
class Fused:
    """Several estimates combined.

    Attributes:
        factor: on the map's lengths.
        sigma_log: standard deviation of the natural log of ``factor``.
        weights: one for each estimate, together 1; 0 for those that were left out.
        contradict: True where estimates contradict each other and none of them could be left out.
    """

    factor: float
    sigma_log: float
    weights: tuple[float, ...]
    contradict: bool = False


def fused(estimates: Sequence[ScaleEstimate]) -> Fused:
    """Combine independent estimates by inverse variance of the log, without those that others outvote.

    The estimates are taken of the largest set in which each pair agrees to :data:`AGREE` standard deviations.
    Of two sets, that with more measured estimates is larger, then that with more estimates. Where two sets
    are equally large, their estimates contradict each other and all of them are taken. The variance is
    multiplied by chi square per degree of freedom where that is above 1 (Birge 1932).

    Args:
        estimates: at least one with a finite uncertainty; the others get no weight.
    """
    logs = np.log([estimate.factor for estimate in estimates])
    information = np.array([_information(estimate) for estimate in estimates])
    chosen, contradict = _largest_agreement(estimates, logs, information)
    weights = np.zeros(len(estimates))
    weights[chosen] = information[chosen] / information[chosen].sum()
    log_factor = float(weights @ logs)
    variance = 1.0 / float(information[chosen].sum())
    if len(chosen) > 1:
        chi_square = float(information[chosen] @ (logs[chosen] - log_factor) ** 2)
        variance *= max(1.0, chi_square / (len(chosen) - 1))
    return Fused(math.exp(log_factor), math.sqrt(variance), tuple(map(float, weights)), contradict)


def apart(a: ScaleEstimate, b: ScaleEstimate) -> float:
    """Difference of the logs of two stated estimates, in standard deviations of that difference."""
    assert a.sigma_log is not None
    assert b.sigma_log is not None
    return abs(math.log(a.factor / b.factor)) / math.hypot(a.sigma_log, b.sigma_log)


def _information(estimate: ScaleEstimate) -> float:
    return float(estimate.sigma_log) ** -2 if estimate.is_stated and estimate.sigma_log is not None else 0.0


def _largest_agreement(
    estimates: Sequence[ScaleEstimate], logs: np.ndarray, information: np.ndarray
) -> tuple[list[int], bool]:
    """Indices of the estimates to combine, and whether they contradict each other."""
    stated = [i for i, estimate in enumerate(estimates) if estimate.is_stated]
    if not stated:
        raise ValueError("no estimate has a finite uncertainty")

    def agree(some: Sequence[int]) -> bool:
        return all(apart(estimates[i], estimates[j]) <= AGREE for i, j in combinations(some, 2))

    def size(some: Sequence[int]) -> tuple[int, int]:
        return sum(estimates[i].is_measured for i in some), len(some)

    sets = [some for n in range(len(stated), 0, -1) for some in combinations(stated, n) if agree(some)]
    most = max(size(some) for some in sets)
    largest = [some for some in sets if size(some) == most]
    chosen = sorted({i for some in largest for i in some})
    return chosen, len(largest) > 1
