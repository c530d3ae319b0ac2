# SPDX-License-Identifier: Apache-2.0
"""Links out of ``docs/`` become text, and pages that are missing leave the menu of the site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?!experiments/)[^)]*\)|\[([^\]]+)\]\((?:examples/)[^)]*\)")
_ROLE = re.compile(r":(?:func|class|meth|attr|mod|data):<code>~?([^<]*)</code>")


def on_config(config: Any) -> Any:
    """Leave out entries of the menu whose file does not exist."""
    config.nav = _existing(config.nav, Path(config.docs_dir))
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files that are no pages are shown as text; links of pages in folders stay."""
    depth = page.file.src_uri.count("/")
    return _OUTSIDE.sub(lambda found: _as_text(found, depth), markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Sphinx's roles of docstrings become plain code."""
    return _ROLE.sub(r"<code>\1</code>", html)


def _as_text(found: re.Match[str], depth: int) -> str:
    target = found[0].partition("](")[2]
    stays = depth and target.count("../") <= depth and not target.startswith("../../")
    return found[0] if stays else (found[1] or found[2])


def _existing(entries: Any, folder: Path) -> Any:
    kept = []
    for entry in entries or []:
        ((title, target),) = entry.items()
        if isinstance(target, list):
            below = _existing(target, folder)
            kept += [{title: below}] if below else []
        elif (folder / target).is_file():
            kept.append(entry)
    return kept
