# SPDX-License-Identifier: Apache-2.0
"""Pages from the templates of ``slamdepth/report/templates``; every text that comes in is escaped there."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING

from slamdepth._version import __version__
from slamdepth.report.text import count, fixed, percent

if TYPE_CHECKING:
    from jinja2 import Environment


def render(template: str, **content: object) -> str:
    """The page of ``template`` with ``content``, as one self-contained HTML text."""
    return (
        _environment()
        .get_template(template)
        .render(**{"version": __version__, "script_hashes": "", **content})
    )


def data_address(data: bytes, mime_type: str) -> str:
    """``data`` as a ``data:`` address, so that a page needs no other file."""
    return f"data:{mime_type};base64,{base64.b64encode(data).decode('ascii')}"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("slamdepth.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(count=count, fixed=fixed, percent=percent, dotted=_dotted)
    environment.tests["checksum"] = _is_checksum
    return environment


def _dotted(settings: Mapping[str, object]) -> list[tuple[str, str]]:
    """Nested settings as rows of dotted names and values."""
    return [(name, str(value)) for name, value in _leaves(settings)]


def _leaves(settings: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _is_checksum(text: str) -> bool:
    """True for a commit or a sha256, which a page sets small and may break anywhere."""
    return len(text) >= 40 and all(c in "0123456789abcdef" for c in text.removesuffix("+changes"))
