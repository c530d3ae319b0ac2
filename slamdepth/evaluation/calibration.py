# SPDX-License-Identifier: Apache-2.0
"""Calibration of predicted standard deviations: expected against observed coverage.

An interval of ``z`` standard deviations to both sides is expected to hold a share ``2 Phi(z) - 1`` of the
errors, where errors are Gaussian. The share it does hold, over that, is the calibration curve of a regression
(Kuleshov, Fenner and Ermon, ICML 2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from slamdepth.typing import Floats

EXPECTED = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.6827, 0.75, 0.8, 0.85, 0.9, 0.9545, 0.99)
"""Expected coverages of a curve: among them those of one and two standard deviations."""

_STEPS = np.array([NormalDist().inv_cdf(0.5 + 0.5 * share) for share in EXPECTED])


@dataclass(frozen=True)
class Coverage:
    """A calibration curve.

    Attributes:
        observed: share of the errors inside the interval that is expected to hold :data:`EXPECTED`.
        known: share of the cases with a finite standard deviation; the curve is of these.
        cases: number of all cases.
    """

    observed: tuple[float, ...]
    known: float
    cases: int


def observed(error: Floats, sigma: Floats) -> Floats:
    """Share of errors inside each interval of :data:`EXPECTED`; NaN without a finite deviation.

    Args:
        error: ``(N,)``.
        sigma: ``(N,)`` predicted standard deviations, in the unit of ``error``; infinite where unknown.
    """
    known = np.isfinite(sigma)
    if not known.any():
        return np.full(len(EXPECTED), np.nan)
    ratio = np.sort(np.abs(error[known]) / np.maximum(sigma[known], 1e-12))
    return np.asarray(np.searchsorted(ratio, _STEPS, side="right") / len(ratio))


def coverage_of(error: Floats, sigma: Floats) -> Coverage:
    """The calibration curve of ``error (N,)`` given ``sigma (N,)``, infinite where unknown; N above 0."""
    return Coverage(
        tuple(observed(error, sigma).tolist()), float(np.isfinite(sigma).mean()), len(np.atleast_1d(error))
    )
