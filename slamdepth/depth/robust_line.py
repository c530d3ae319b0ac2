# SPDX-License-Identifier: Apache-2.0
"""A straight line through positive quantities whose errors grow with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_TUKEY = 4.685  # 95 % of least squares' efficiency where errors are Gaussian
_SMALLEST_SPREAD = 1e-4


def robust_line(
    x: Floats, y: Floats, start: tuple[float, float] | None = None, spread: float | None = None
) -> tuple[float, float, float]:
    """``slope`` and ``intercept`` of ``y = slope * x + intercept``, robustly, by relative error.

    Minimised are ``(y - m) / m`` with ``m`` the line: what a generalised linear model with a
    Gamma distribution and the identity link weighs by (McCullagh and Nelder 1989, chapter
    8), so that far points don't outweigh near ones. Dividing by ``y`` instead would pull
    the line down wherever ``y`` is uncertain. First least absolute deviations, then Tukey's
    biweight about them (Huber and Ronchetti, "Robust Statistics", 2009, 7.8), which lets
    outliers go.

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
        line = _solve(design, y, 1.0 / y**2)
        for _ in range(40):
            residual, mean = _residual(design, y, line, lowest)
            line = _solve(design, y, 1.0 / (np.maximum(np.abs(residual), 1e-3) * mean**2))
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


def _residual(design: Floats, y: Floats, line: Floats, lowest: float) -> tuple[Floats, Floats]:
    """Logs of ``y`` over the line, and the line's values, kept from crossing zero.

    To first order they are the relative residuals, but too large and too small weigh alike.
    """
    mean = np.maximum(design @ line, lowest)
    return np.log(y / mean), mean


def _solve(design: Floats, y: Floats, weight: Floats) -> Floats:
    weighted = design * weight[:, None]
    return np.linalg.lstsq(design.T @ weighted, weighted.T @ y, rcond=None)[0]
