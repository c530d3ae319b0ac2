# SPDX-License-Identifier: Apache-2.0
"""Pieces of HTML; every text that comes in is escaped here."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Any


def section(title: str, intro: str, body: str) -> str:
    """A card with a heading and one line that says what it shows; ``body`` is HTML."""
    return f'<section><h2>{escape(title)}</h2><p class="why">{escape(intro)}</p>{body}</section>\n'


def tile(name: str, value: str, detail: str) -> str:
    """One large figure; what follows its first blank is set small, as a unit."""
    number, _, unit = value.partition(" ") if value[:1].isdigit() else (value, "", "")
    small = f" <small>{escape(unit)}</small>" if unit else ""
    return (
        f'<div class="tile"><div class="name">{escape(name)}</div>'
        f'<div class="value">{escape(number)}{small}</div><div class="detail">{escape(detail)}</div></div>'
    )


def table(heads: list[str], rows: list[list[str]], *, text: bool = False) -> str:
    """A table whose first column names the rows; the others are numbers unless ``text``."""
    kind = "text" if text else "number"
    head = ""
    if heads:
        cells = "".join(f'<th class="{kind}">{escape(name)}</th>' for name in heads[1:])
        head = f"<thead><tr><th>{escape(heads[0])}</th>{cells}</tr></thead>"
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(f'<td class="{kind}">{_cell(value)}</td>' for value in row[1:])
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table>{head}<tbody>{body}</tbody></table></div>'


def plot(svg: str | None, caption: str) -> str:
    """A figure with its explanation, or nothing where there is no plot."""
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>" if svg else ""


def collapsed(title: str, body: str) -> str:
    """HTML that a click opens."""
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def settings_table(settings: dict[str, Any]) -> str:
    """Nested settings as rows of dotted names."""
    return table([], [[name, str(value)] for name, value in _flat(settings)], text=True)


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _cell(value: str) -> str:
    is_hash = len(value) >= 40 and all(c in "0123456789abcdef" for c in value.removesuffix("+changes"))
    return f'<span class="hash">{escape(value)}</span>' if is_hash else escape(value)
