# SPDX-License-Identifier: Apache-2.0
"""three.js (MIT), which draws the 3D view of a page: read from the installed trimesh, which brings it."""

from __future__ import annotations

import io
import re
import zipfile
from importlib import resources

from slamdepth.errors import SlamdepthError

_PLACE = "resources/templates/viewer.zip"
_PAGE = "viewer.html.template"
_END = 'Object.defineProperty(t,"__esModule",{value:!0})}));'  # the last words of its bundle


def three_js() -> str:
    """The text of three.js, which defines ``THREE``; its licence is in its first lines.

    Raises:
        SlamdepthError: trimesh is not installed, or has no three.js where version 5 has it.
    """
    try:
        archive = (resources.files("trimesh") / _PLACE).read_bytes()
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            page = opened.read(_PAGE).decode("utf-8")
    except (ImportError, OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise SlamdepthError(
            f"three.js cannot be read from trimesh ({error}); 'pip install \"trimesh>=5,<6\"' installs it"
        ) from error
    script = re.search(
        r"<script>(/\*\*\s+\* @license\s+\* Copyright .*? Three\.js Authors.*)", page, re.DOTALL
    )
    end = page.find(_END)
    if script is None or end < script.start(1):
        raise SlamdepthError("three.js is not where trimesh 5 has it; install 'trimesh>=5,<6'")
    text = page[script.start(1) : end + len(_END)]
    if "</script" in text:
        raise SlamdepthError("the three.js of this trimesh cannot be put into a page")
    return text
