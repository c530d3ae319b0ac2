# SPDX-License-Identifier: Apache-2.0
"""Links out of the pages of ``docs/`` become text on the site."""

from __future__ import annotations

import re
from typing import Any

_LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)*)(examples/)?[^)]*\)")
_ROLE = re.compile(r":(?:func|class|meth|attr|mod|data):<code>~?([^<]*)</code>")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links that leave ``docs/``, and those to the examples, are shown as text."""
    depth = page.file.src_uri.count("/")

    def shown(link: re.Match[str]) -> str:
        is_outside = link[2].count("../") > depth or link[3]
        return link[1] if is_outside else link[0]

    return _LINK.sub(shown, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Sphinx's roles of docstrings become plain code."""
    return _ROLE.sub(r"<code>\1</code>", html)
