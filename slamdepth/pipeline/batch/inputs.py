# SPDX-License-Identifier: Apache-2.0
"""The recordings of a batch: paths, patterns, and lists of them in a text file."""

from __future__ import annotations

import glob
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slamdepth.datasets.readers.live import LiveReader
from slamdepth.errors import DatasetError
from slamdepth.io import read_lines

_PATTERN = "*?["
LIST_ENDING = ".txt"


@dataclass(frozen=True)
class Recording:
    """One recording of a batch.

    Attributes:
        path: as ``slamdepth run`` takes it; ``rtsp://...`` and ``camera:0`` stay as they are.
        options: of its line in a list, which come after those of the batch.
    """

    path: str
    options: tuple[str, ...] = ()


def find_recordings(inputs: Sequence[str]) -> tuple[Recording, ...]:
    """The recordings that the arguments of a batch name, each once with the same options, in order.

    Args:
        inputs: paths; patterns with ``*``, ``?`` or ``[...]``, whose matches are sorted; and ``.txt`` files
            with a recording a line, perhaps followed by options of ``slamdepth run``, as a shell would read
            them. Paths in a list are relative to the list.

    Raises:
        DatasetError: a pattern matches nothing, a list is missing, empty or malformed, or nothing is named.
    """
    found: list[Recording] = []
    for text in inputs:
        path = Path(text).expanduser()
        if _is_live(text):
            found.append(Recording(text))
        elif path.suffix.lower() == LIST_ENDING and not path.is_dir():
            found += _of_list(path)
        elif any(character in text for character in _PATTERN) and not path.exists():
            matches = sorted(glob.glob(str(path)))
            if not matches:
                raise DatasetError(f"{text}: matches no file and no folder")
            found += [Recording(match) for match in matches]
        else:
            found.append(Recording(str(path)))
    if not found:
        raise DatasetError("no recordings: name videos, folders, patterns, or a .txt list of them")
    return tuple(dict.fromkeys(found))


def _is_live(text: str) -> bool:
    """Whether a recording is a live source rather than a file."""
    return LiveReader().matches(Path(text))


def _of_list(path: Path) -> list[Recording]:
    if not path.exists():
        raise DatasetError(f"{path}: no such list of recordings")
    found = []
    for number, line in read_lines(path):
        try:
            words = shlex.split(line)
        except ValueError as error:
            raise DatasetError(f"{path}:{number}: {error}: quote paths as in a shell") from error
        if words:
            place = words[0] if _is_live(words[0]) else str(path.parent / Path(words[0]).expanduser())
            found.append(Recording(place, tuple(words[1:])))
    if not found:
        raise DatasetError(f"{path}: lists no recordings; a line is a path, optionally with options of a run")
    return found
