# SPDX-License-Identifier: Apache-2.0
"""A straight line through positive quantities whose errors grow with them."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

_TUKEY = 4.685  # 95 % of least squares' efficiency where errors are Gaussian
_SMALLEST_SPREAD = 1e-4
_PAIRS, _JUDGED = 300, 1500


def robust_line(
    x: Floats, y: Floats, start: tuple[float, float] | None = None, spread: float | None = None
) -> tuple[float, float, float]:
    """``slope`` and ``intercept`` of ``y = slope * x + intercept``, robustly, by relative error.

    Minimised are ``(y - m) / m`` with ``m`` the line: what a generalised linear model with a
    Gamma distribution and the identity link weighs by (McCullagh and Nelder 1989, chapter
    8), so that far points don't outweigh near ones. Dividing by ``y`` instead would pull
    the line down wherever ``y`` is uncertain. The line through two points with the least
    median residual (Rousseeuw 1984) starts it, then Tukey's biweight lets outliers go and
    uses the rest fully: an MM-estimate (Yohai 1987). Least absolute deviations would not do
    as a start: outliers far out in ``x`` turn them.

    Args:
        x: ``(N,)`` finite; y: ``(N,)`` positive.
        start, spread: of an earlier fit of much the same points; spares the first stage.

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
        spread = max(1.4826 * float(np.median(np.abs(residual))), _SMALLEST_SPREAD)
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
    """The best of lines through random pairs, judged by the median over some points."""
    rng = np.random.default_rng(0)
    some = rng.permutation(len(y))[:_JUDGED]
    a, b = rng.integers(0, len(y), (2, _PAIRS))
    run = design[b, 0] - design[a, 0]
    use = np.abs(run) > 0
    a, b, run = a[use], b[use], run[use]
    slopes = (y[b] - y[a]) / run
    lines = np.column_stack([slopes, y[a] - slopes * design[a, 0]])
    least = _solve(design, y, 1.0 / y**2)
    lines = np.vstack([least, lines])
    cost = [np.median(np.abs(_residual(design[some], y[some], line, lowest)[0])) for line in lines]
    return np.asarray(lines[int(np.argmin(cost))], dtype=np.float64)


def _residual(design: Floats, y: Floats, line: Floats, lowest: float) -> tuple[Floats, Floats]:
    """Logs of ``y`` over the line, and the line's values, kept from crossing zero.

    To first order they are the relative residuals, but too large and too small weigh alike.
    """
    mean = np.maximum(design @ line, lowest)
    return np.log(y / mean), mean


def _solve(design: Floats, y: Floats, weight: Floats) -> Floats:
    weighted = design * weight[:, None]
    return np.linalg.lstsq(design.T @ weighted, weighted.T @ y, rcond=None)[0]
