# SPDX-License-Identifier: Apache-2.0
"""How well several passes over a recording tell its focal length together.

What a tracker accepts agrees with the camera that it tracked with, so a pass finds less than the whole way
to the truth. With logarithms of focal lengths, ``f_i`` tracked with and ``g_i`` found by pass ``i``,

    g_i = a + m (f_i - a) + e_i,      e_i ~ N(0, s_i^2 + t^2)

``a`` is the focal length: the one that a pass finds again. The memory ``m`` is 0 where the motion alone
decides, and 1 where a pass gives back what it was given. ``s_i`` is what pass ``i`` claims of its own error,
and ``t`` the scatter of passes beyond it, which is unknown as well. This is a regression of a random-effects
meta-analysis (DerSimonian and Laird 1986), with the posterior of ``a`` by quadrature over ``m`` and ``t``:
where all passes started from one focal length the memory is not known, and neither is ``a``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SCATTER = 0.02
"""Median of what is expected of ``t``: what windows of seven recordings were off beyond what they claimed."""

_SCATTER_FACTOR = 2.0  # one deviation of log t
_MEMORIES = np.linspace(0.0, 0.99, 100)
_SCATTERS = np.geomspace(0.004, 0.5, 60)


@dataclass(frozen=True)
class Pass:
    """A stretch of a recording, tracked and adjusted by itself.

    Attributes:
        tracked_log_f, found_log_f: logarithm of the focal length before and after the adjustment.
        sigma: deviation of the latter by its residuals.
    """

    tracked_log_f: float
    found_log_f: float
    sigma: float


@dataclass(frozen=True)
class FocalLength:
    """A focal length by several passes.

    Attributes:
        log_f, sigma: mean and deviation of its logarithm.
        memory: share of a wrong focal length that a pass gives back, 0 to 1.
        scatter: of the passes, beyond what they claim.
    """

    log_f: float
    sigma: float
    memory: float
    scatter: float


def focal_length_of(passes: Sequence[Pass], prior_log_f: float, prior_sigma: float) -> FocalLength:
    """The focal length by all passes and by what was known before, ``N(prior_log_f, prior_sigma^2)``."""
    tracked, found, own = np.array(
        [(one.tracked_log_f, one.found_log_f, one.sigma) for one in passes], dtype=np.float64
    ).reshape(-1, 3).T  # fmt: skip
    m, t = np.meshgrid(_MEMORIES, _SCATTERS, indexing="ij")
    weight = 1.0 / (own**2 + t[..., None] ** 2)
    # g - m f = (1 - m) a + e, about the prior's mean
    share = 1.0 - m[..., None]
    rest = (found - prior_log_f) - m[..., None] * (tracked - prior_log_f)
    information = (weight * share**2).sum(axis=-1) + 1.0 / prior_sigma**2
    mean = (weight * share * rest).sum(axis=-1) / information
    misfit = (weight * rest**2).sum(axis=-1) - information * mean**2
    log_p = 0.5 * (np.log(weight).sum(axis=-1) - np.log(information) - misfit)
    log_p -= 0.5 * (np.log(t / SCATTER) / np.log(_SCATTER_FACTOR)) ** 2
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    a = float((p * mean).sum())
    variance = float((p * (1.0 / information + (mean - a) ** 2)).sum())
    return FocalLength(
        prior_log_f + a, variance**0.5, float((p * m).sum()), float(np.exp((p * np.log(t)).sum()))
    )
