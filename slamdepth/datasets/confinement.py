# SPDX-License-Identifier: Apache-2.0
"""What a sequence may not do unasked: lead to files outside of its folder, or come as an archive.

A downloaded sequence is foreign input. A list with ``../``, an absolute path or a link could have any image
of this machine read and shown in a report that is passed on.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

from slamdepth.datasets.base import Dataset
from slamdepth.errors import DatasetError

_ARCHIVES = (".zip", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz", ".tar.zst", ".7z", ".rar")


def check_confined(dataset: Dataset) -> None:
    """Refuse a sequence of files some of which lie outside of its folder.

    Raises:
        DatasetError: one does; names it and where it leads to.
    """
    check_inside(dataset.path, dataset.files())


def check_inside(folder: Path, paths: Iterable[Path]) -> None:
    """Refuse paths that lie outside of ``folder``, by their name or because they are links.

    The folder itself may be a link.

    Raises:
        DatasetError: names the first one.
    """
    root = (folder if folder.is_dir() else folder.parent).resolve()
    parents: dict[Path, Path] = {}
    for path in paths:
        try:
            # Thousands of images lie in one folder, which is resolved once.
            parent = parents.get(path.parent) or parents.setdefault(path.parent, path.parent.resolve())
            place = path.resolve() if path.is_symlink() else parent / path.name
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: a link to itself
            raise DatasetError(f"{path}: cannot be found: {error}") from error
        if path.name == ".." or not place.is_relative_to(root):
            raise DatasetError(
                f"{path}: leads out of the sequence, to {place}: add --follow-links if you trust where it "
                "comes from"
            )


def refuse_archive(path: Path) -> None:
    """Raise DatasetError where ``path`` is an archive; says how to unpack it."""
    name = path.name.lower()
    ending = next((ending for ending in _ARCHIVES if name.endswith(ending)), None)
    if ending is None or not path.is_file():
        return
    folder = path.name[: -len(ending)] or "sequence"
    quoted, to = shlex.quote(str(path)), shlex.quote(folder)
    command = {
        ".zip": f"unzip {quoted} -d {to}",
        ".7z": f"7z x {quoted} -o{to}",
        ".rar": f"unrar x {quoted} {to}/",
    }.get(ending, f"mkdir -p {to} && tar -xf {quoted} -C {to}")
    raise DatasetError(f"{path}: is an archive; unpack it first: {command}")
