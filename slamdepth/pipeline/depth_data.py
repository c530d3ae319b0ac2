# SPDX-License-Identifier: Apache-2.0
"""Images with sensor depth, however they are stored."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from slamdepth.datasets import Dataset, ReadOptions, open_dataset
from slamdepth.datasets.intrinsics import tell_guess
from slamdepth.datasets.sensor_depth import check_sensor_depth, lack_of_depth
from slamdepth.errors import DatasetError
from slamdepth.pipeline.training_data import SequencePlace, sequence_readers
from slamdepth.training.data import Place, data_folder, known_readers, open_place, split_numbers
from slamdepth.types import Frame

logger = logging.getLogger(__name__)

_SEQUENCE_STRIDE = 10


def open_depth_data(
    path: Path, *, camera: Path | None = None, reading: ReadOptions | None = None
) -> list[Place]:
    """Open a folder of images with depth.

    It holds training pairs (``camera.json``), a Hypersim scene or a sequence of a known layout, or several of
    these in folders of their own.

    Args:
        path: absolute, relative to the current folder, or below ``$SLAMDEPTH_DATA``; ``NAME[FIRST-LAST]``
            for some of the numbered pairs in a folder.
        camera: a ``camera.yaml`` for a sequence.
        reading: how a sequence is opened.

    Raises:
        DatasetError: the folder is missing, a file, not to be read, of no known kind, malformed, or has
            no depth.
        CameraError: the intrinsics of a sequence are unknown or malformed.
    """
    places, sequences = _contents(path)
    if places and camera is not None:
        raise DatasetError(f"{places[0]}: its camera is known with it; leave out --camera")
    if places:
        return [open_place(place) for place in places]
    if not sequences:
        layouts = {**known_readers(), **sequence_readers()}
        known = "; ".join(f"{name} ({reader.needs})" for name, reader in layouts.items() if name != "video")
        raise DatasetError(
            f"{path}: no known sequence layout and no other images with depth; known are: {known}"
        )
    return _with_depth([open_dataset(sequence, camera, reading) for sequence in sequences])


def _contents(path: Path) -> tuple[list[Path], list[Path]]:
    """Folders of pairs or scenes in ``path`` (or ``path`` itself), or, where there are none, of sequences."""
    try:
        if path.is_file():
            raise DatasetError(f"{path}: is a file; name a folder of images with depth")
        whole, numbers = split_numbers(path)
        folder = data_folder(str(whole))
        if _is_place(folder):
            return [folder if numbers is None else folder.with_name(path.name)], []
        if _is_sequence(folder):
            return [], [folder]
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    places = _inside(folder, _is_place)
    return places, [] if places else _inside(folder, _is_sequence)


def _with_depth(datasets: list[Dataset]) -> list[Place]:
    """Those that have sensor depth; the others are left out with a warning.

    Raises:
        DatasetError: none of them has any, or depth images cannot be a sensor's.
    """
    with_depth = [dataset for dataset in datasets if dataset.has_depth]
    if not with_depth:
        return [SequencePlace.of(datasets[0])]  # raises, and names it
    for dataset in datasets:
        if not dataset.has_depth:
            logger.warning("%s: left out, %s", dataset.path, lack_of_depth(dataset))
    places: list[SequencePlace] = [SequencePlace.of(dataset) for dataset in with_depth]
    for place in places:
        tell_guess(place.name, place.dataset.camera_source)
        for note in check_sensor_depth(place.dataset, place.frames):
            logger.warning("%s: %s", place.name, note)
    return [*places]


def _is_place(folder: Path) -> bool:
    return any(reader.matches(folder) for reader in known_readers().values())


def _is_sequence(folder: Path) -> bool:
    return any(reader.matches(folder) for reader in sequence_readers().values())


def _inside(folder: Path, is_wanted: Callable[[Path], bool]) -> list[Path]:
    """The subfolders that are wanted; one that cannot be read is left out with a warning."""
    found = []
    for below in sorted(folder.glob("*")):
        try:
            if below.is_dir() and is_wanted(below):
                found.append(below)
        except OSError as error:
            logger.warning("%s: left out, cannot be read: %s", below, error.strerror or error)
    return found


def thinned(place: Place, stride: int | None = None, max_frames: int | None = None) -> list[int]:
    """Which images of ``place`` to look at.

    Args:
        stride: every Nth image; in a sequence, images without depth count too. Default: 10 for sequences,
            1 for others, which are thinned already.
        max_frames: at most this many, spread evenly.
    """
    numbers: Iterable[int] = range(len(place))
    if isinstance(place, SequencePlace):
        stride, numbers = stride or _SEQUENCE_STRIDE, place.frames
    chosen = [index for index, number in enumerate(numbers) if number % (stride or 1) == 0]
    if max_frames is None or len(chosen) <= max_frames:
        return chosen
    spread = np.linspace(0, len(chosen) - 1, max_frames).round().astype(int)
    return [chosen[position] for position in spread.tolist()]


def shown(indices: Sequence[int], count: int) -> set[int]:
    """Up to ``count`` of ``indices`` to be drawn, evenly spread, without the first and the last."""
    positions = np.linspace(0, len(indices) - 1, count + 2).round().astype(int)[1:-1]
    return {indices[position] for position in positions.tolist()} if indices else set()


def readable(place: Place, indices: Iterable[int]) -> Iterator[Frame]:
    """The frames in order; one that cannot be read is left out with a warning."""
    for index in indices:
        try:
            yield place.read(index)
        except DatasetError as error:
            logger.warning("frame left out: %s", error)
