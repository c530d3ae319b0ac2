# SPDX-License-Identifier: Apache-2.0
"""Tables of documents."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Headings and rows of as many cells, which may hold any text of one line."""
    lines = [_line(headings), "| --- " * len(headings) + "|"]
    return "\n".join([*lines, *(_line([cell.replace("|", "\\|") for cell in row]) for row in rows)])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
