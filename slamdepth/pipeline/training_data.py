# SPDX-License-Identifier: Apache-2.0
"""Sequences as places to train on: every layout of ``slamdepth.datasets``, under its name.

The packages ``training`` and ``datasets`` do not import one another; this module connects them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamdepth.datasets import Dataset, Reader, known_readers
from slamdepth.datasets.sensor_depth import lack_of_depth
from slamdepth.datasets.sequence import ImageSequence, is_file
from slamdepth.errors import CameraError, DatasetError, ImageDecodeError
from slamdepth.synth.sequence import SETTINGS_FILE
from slamdepth.training.data import PlaceReader, fingerprint
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

_BENCHMARKS = {"tum": "sequences in the TUM RGB-D layout", "7scenes": "7-Scenes sequences"}
"""The benchmark that a head trained on a layout has seen. Own recordings in that layout count too."""


@dataclass(frozen=True)
class SequencePlace:
    """The frames of a sequence that have sensor depth, in raw (distorted) pixels.

    Attributes:
        dataset: the sequence.
        frames: indices of these frames in ``dataset``.
        benchmark: the benchmark it belongs to, or None.
    """

    dataset: Dataset
    frames: tuple[int, ...]
    benchmark: str | None

    @classmethod
    def of(cls, dataset: Dataset, benchmark: str | None = None) -> SequencePlace:
        """The frames of ``dataset`` that have an image and depth; files are not opened.

        Raises:
            DatasetError: there are none.
        """
        if isinstance(dataset, ImageSequence):
            paths = zip(dataset.image_paths, dataset.depth_paths, strict=True)
            frames = tuple(
                k for k, (image, depth) in enumerate(paths) if depth is not None and is_file(image)
            )
        else:
            frames = tuple(range(len(dataset))) if dataset.has_depth else ()
        if not frames:
            raise DatasetError(f"{dataset.path}: {lack_of_depth(dataset)}")
        return cls(dataset, frames, benchmark)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def name(self) -> str:
        return self.dataset.name

    @property
    def camera(self) -> Camera:
        return self.dataset.camera

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(self.dataset.notes)

    @property
    def fingerprint(self) -> str:
        if isinstance(self.dataset, ImageSequence):
            both = (self.dataset.image_paths, self.dataset.depth_paths)
            files = (path for paths in both for k in self.frames if (path := paths[k]) is not None)
            return fingerprint(files, self.camera, self.frames)
        times = np.asarray(self.dataset.timestamps_s).tolist()
        return fingerprint((), str(self.dataset.path), times, self.camera, self.frames)

    def read(self, index: int) -> Frame:
        """Frame ``index`` among those with depth; see :meth:`slamdepth.training.data.Place.read`."""
        try:
            frame = self.dataset.read(self.frames[index], with_depth=True)
        except (ImageDecodeError, CameraError) as error:
            raise DatasetError(str(error)) from error
        if frame.depth_m is None:
            raise DatasetError(f"{self.dataset.path}: frame {self.frames[index]} has no depth")
        return replace(frame, index=index)

    def gravity(self, index: int) -> Floats | None:
        """None: sequences do not record gravity."""
        del index
        return None


@dataclass(frozen=True)
class SequenceReader:
    """Adapts a reader of sequences to a reader of places."""

    reader: Reader

    @property
    def name(self) -> str:
        return self.reader.name

    @property
    def needs(self) -> str:
        return f"{self.reader.needs}; depth is not optional here"

    def matches(self, folder: Path) -> bool:
        return self.reader.matches(folder)

    def open(self, folder: Path) -> SequencePlace:
        return SequencePlace.of(self.reader.open(folder, None), _BENCHMARKS.get(self.name))


@dataclass(frozen=True)
class SynthReader(SequenceReader):
    """Opens sequences rendered by ``slamdepth synth``: in TUM layout, but not of the TUM benchmark."""

    @property
    def name(self) -> str:
        return "synth"

    @property
    def needs(self) -> str:
        return f"a folder of 'slamdepth synth' with {SETTINGS_FILE}"

    def matches(self, folder: Path) -> bool:
        return (folder / SETTINGS_FILE).is_file()

    def open(self, folder: Path) -> SequencePlace:
        if not self.matches(folder):
            raise DatasetError(f"{folder}: no {SETTINGS_FILE} here, so 'slamdepth synth' did not render it")
        return super().open(folder)


def sequence_readers() -> dict[str, PlaceReader]:
    """Readers of every sequence layout; ``synth`` comes before ``tum``, whose layout it shares."""
    layouts = {reader.name: reader for reader in known_readers() if reader.name != "live"}
    readers: dict[str, PlaceReader] = {"synth": SynthReader(layouts["tum"])}
    readers.update({name: SequenceReader(reader) for name, reader in layouts.items()})
    return readers
