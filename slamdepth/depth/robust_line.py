# SPDX-License-Identifier: Apache-2.0
"""A robust line fit for positive values with relative errors."""

from __future__ import annotations

import numpy as np

from slamdepth.robust import robust_deviation
from slamdepth.typing import Floats

_TUKEY = 4.685  # 95 % efficiency for Gaussian errors
_MIN_SPREAD = 1e-4
_PAIRS, _SCORED = 300, 1500


def robust_line(
    x: Floats, y: Floats, start: tuple[float, float] | None = None, spread: float | None = None
) -> tuple[float, float, float]:
    """Fit ``y = slope * x + intercept`` robustly, by relative error.

    The residuals are ``(y - m) / m`` with ``m`` the line, as in a generalised linear model with a Gamma
    distribution and the identity link (McCullagh and Nelder 1989, chapter 8), so that far points do not
    outweigh near ones. Dividing by ``y`` instead would bias the line downwards wherever ``y`` is uncertain.
    The fit is an MM-estimate (Yohai 1987): it starts from the line through two points with the least median
    residual (Rousseeuw 1984) and continues with Tukey's biweight. Least absolute deviations would not do as
    a start, because outliers far out in ``x`` tilt them.

    Args:
        x: ``(N,)`` finite.
        y: ``(N,)`` positive.
        start: slope and intercept of an earlier fit to much the same points; with ``spread`` it replaces the
            first stage.
        spread: standard deviation of the residuals of that fit.

    Returns:
        ``(slope, intercept, spread)``, the last a standard deviation of the residuals.

    Raises:
        ValueError: fewer than two points, or all ``x`` are the same.
    """
    if len(x) < 2 or np.ptp(x) <= 1e-9 * max(1.0, float(np.abs(x).max())):
        raise ValueError("a line needs points at different x")
    lowest = 0.05 * float(np.median(y))
    design = np.column_stack([x, np.ones_like(x)])
    if start is None or spread is None:
        line = _least_median(design, y, lowest)
        residual, _ = _residual(design, y, line, lowest)
        spread = max(robust_deviation(residual, 0.0), _MIN_SPREAD)
    else:
        line = np.array(start)
    for _ in range(20):
        residual, mean = _residual(design, y, line, lowest)
        weight = np.maximum(1.0 - (residual / (_TUKEY * spread)) ** 2, 0.0) ** 2
        before, line = line, _solve(design, y, weight / mean**2)
        if np.all(np.abs(line - before) <= 1e-5 * np.abs(line) + 1e-9):
            break
    return float(line[0]), float(line[1]), spread


def _least_median(design: Floats, y: Floats, lowest: float) -> Floats:
    """The line with the least median residual, of lines through random pairs of points."""
    rng = np.random.default_rng(0)
    scored = rng.permutation(len(y))[:_SCORED]
    a, b = rng.integers(0, len(y), (2, _PAIRS))
    run = design[b, 0] - design[a, 0]
    use = np.abs(run) > 0
    a, b, run = a[use], b[use], run[use]
    slopes = (y[b] - y[a]) / run
    lines = np.column_stack([slopes, y[a] - slopes * design[a, 0]])
    least = _solve(design, y, 1.0 / y**2)
    lines = np.vstack([least, lines])
    cost = [np.median(np.abs(_residual(design[scored], y[scored], line, lowest)[0])) for line in lines]
    return np.asarray(lines[int(np.argmin(cost))], dtype=np.float64)


def _residual(design: Floats, y: Floats, line: Floats, lowest: float) -> tuple[Floats, Floats]:
    """Log ratios of ``y`` to the line, and the line's values, which are kept positive.

    To first order the log ratios are the relative residuals, but too large and too small weigh alike.
    """
    mean = np.maximum(design @ line, lowest)
    return np.log(y / mean), mean


def _solve(design: Floats, y: Floats, weight: Floats) -> Floats:
    weighted = design * weight[:, None]
    line: Floats = np.linalg.lstsq(design.T @ weighted, weighted.T @ y, rcond=None)[0]
    return line
