# SPDX-License-Identifier: Apache-2.0
"""Sequences that begin later: a small file names another sequence and its first frame.

:func:`slamdepth.run` reads such a file as a sequence inside :func:`readable_excerpts`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import yaml

from slamdepth.datasets import Dataset, open_dataset
from slamdepth.datasets.registry import READERS
from slamdepth.errors import DatasetError
from slamdepth.io import write_text
from slamdepth.types import Camera, Frame

ENDING = ".excerpt.yaml"


class Excerpt(Dataset):
    """The frames of ``whole`` from ``start`` on, numbered from 0."""

    def __init__(self, whole: Dataset, start: int) -> None:
        self.name, self.path, self.camera = whole.name, whole.path, whole.camera
        self.timestamps_s = whole.timestamps_s[start:]
        self.has_depth, self.ground_truth, self.notes = whole.has_depth, whole.ground_truth, whole.notes
        self._whole, self._start = whole, start

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        """Read one frame; see :meth:`slamdepth.datasets.base.Dataset.read`.

        Raises:
            IndexError: ``index`` is not in 0 to ``len(self) - 1``.
            ImageDecodeError: an image does not decode.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return replace(self._whole.read(self._start + index, with_depth=with_depth), index=index)


class ExcerptReader:
    """Opens the files of :func:`write_excerpt`."""

    name = "excerpt"
    needs = f"a file *{ENDING} of this benchmark"

    def matches(self, path: Path) -> bool:
        """True for the files of :func:`write_excerpt`."""
        return path.name.endswith(ENDING)

    def open(self, path: Path, camera: Camera | None) -> Excerpt:
        """Open the sequence that the file names; ``camera`` is not used.

        Raises:
            DatasetError: the sequence cannot be opened, or is too short.
            CameraError: its intrinsics are unknown.
        """
        del camera
        named = yaml.safe_load(path.read_text(encoding="utf-8"))
        whole = open_dataset(named["sequence"], named["camera"])
        if named["start"] >= len(whole):
            raise DatasetError(f"{whole.path}: has {len(whole)} frames, none from {named['start']} on")
        return Excerpt(whole, named["start"])


@contextmanager
def readable_excerpts() -> Iterator[None]:
    """Let :func:`slamdepth.open_dataset` read the files of :func:`write_excerpt`."""
    READERS.parts[ExcerptReader.name] = ExcerptReader()
    try:
        yield
    finally:
        del READERS.parts[ExcerptReader.name]


def write_excerpt(folder: Path, sequence: Path, camera_file: Path | None, start: int) -> Path:
    """Write the file of a sequence from frame ``start`` on into ``folder``; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    file = folder / f"{sequence.stem}-{start}{ENDING}"
    camera = None if camera_file is None else str(camera_file.resolve())
    named = {"sequence": str(sequence.resolve()), "camera": camera, "start": start}
    write_text(file, yaml.safe_dump(named))
    return file
