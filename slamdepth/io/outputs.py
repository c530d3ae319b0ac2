# SPDX-License-Identifier: Apache-2.0
"""Checks of output paths, to be made before the work whose result is written there."""

from __future__ import annotations

import os
from pathlib import Path

from slamdepth.errors import OutputError


def writable(path: Path) -> Path:
    """``path``, if it or the nearest existing folder above it can be written.

    Raises:
        OutputError: that folder is a file or may not be written.
    """
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise OutputError(f"{path}: cannot be written: {place} is a file")
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written: no permission to write to {place}")
    return path


def writable_file(path: Path, ending: str) -> Path:
    """``path`` with ``~`` expanded, if a file can be written there without replacing one of another kind.

    A file with the same ``ending`` (such as ``.json``) may be replaced.

    Raises:
        OutputError: it is a folder or another kind of file, it may not be written, or its folder is
            missing or cannot be written.
    """
    path = path.expanduser()
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; name a file for the results")
    if path.exists() and path.suffix.lower() != ending:
        raise OutputError(f"{path}: is there already and no {ending} file; name another file")
    if not path.parent.exists():
        raise OutputError(f"{path.parent}: no such folder to write to; make it first")
    writable(path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(f"{path}: cannot be written: no permission to replace it")
    return path
