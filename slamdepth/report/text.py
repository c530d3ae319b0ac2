# SPDX-License-Identifier: Apache-2.0
"""How figures are written for people, in the console and in the HTML."""

from __future__ import annotations

MISSING = "–"


def count(value: int | None) -> str:
    """A whole number, its thousands separated by narrow no-break spaces."""
    return MISSING if value is None else f"{value:,}".replace(",", "\u202f")


def fixed(value: float | None, digits: int, unit: str = "") -> str:
    """``value`` with ``digits`` digits after the point, and its unit."""
    return MISSING if value is None else f"{value:.{digits}f}{f' {unit}' if unit else ''}"


def percent(fraction: float | None, digits: int = 1) -> str:
    """A share as per cent, never rounded up to a full hundred."""
    if fraction is None:
        return MISSING
    text = f"{100 * fraction:.{digits}f}"
    if fraction < 1 and float(text) >= 100:
        text = f"{100 - 10**-digits:.{digits}f}"
    return f"{text} %"
