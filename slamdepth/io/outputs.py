# SPDX-License-Identifier: Apache-2.0
"""Checks of output paths, to be made before the work whose result is written there."""

from __future__ import annotations

import os
from collections.abc import Callable
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


def results_folder(folder: Path, is_ours: Callable[[Path], bool], what: str, *, overwrite: bool) -> Path:
    """``folder`` with ``~`` expanded, if results can be written there without replacing anything else.

    Args:
        is_ours: whether a folder with something in it holds earlier results of the same kind.
        what: names these in messages, such as "run".
        overwrite: they may be replaced.

    Raises:
        OutputError: it is a file, holds something else or earlier results, or cannot be read or written.
    """
    folder = folder.expanduser()
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file; name a folder for the results")
        is_empty = not (folder.is_dir() and any(folder.iterdir()))
        if not is_empty and not is_ours(folder):
            raise OutputError(f"{folder}: is not empty and holds no earlier {what}; name a new folder")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be read: {error.strerror or error}") from error
    if not is_empty and not overwrite:
        raise OutputError(f"{folder}: holds an earlier {what}; name another folder or add --overwrite")
    return writable(folder)


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
