# SPDX-License-Identifier: Apache-2.0
"""Places, the sources of training images with depth, and the readers that open them.

A reader is one file in ``slamdepth/training/readers/`` with a class under ``@register_reader``.
The caller of a training may pass further readers; the pipeline passes those of the sequence
layouts in ``slamdepth.datasets``.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from slamdepth.errors import DatasetError
from slamdepth.registry import Registry
from slamdepth.types import Camera, Frame
from slamdepth.typing import Floats

logger = logging.getLogger(__name__)

_NUMBERS = re.compile(r"(?P<name>.+)\[(?P<first>\d+)-(?P<last>\d+)\]")


class Place(Protocol):
    """Images with depth taken by one camera, read one at a time.

    Attributes:
        name: short name; with the seed it determines the random views.
        camera: the camera of all its images.
        notes: what was guessed, dropped or repaired on opening, one line each.
        benchmark: the benchmark that a head trained on it has seen, or None.
        fingerprint: hash of everything that determines its views: files, sizes, camera.
    """

    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def notes(self) -> tuple[str, ...]: ...
    @property
    def benchmark(self) -> str | None: ...
    @property
    def fingerprint(self) -> str: ...

    def __len__(self) -> int: ...

    def read(self, index: int) -> Frame:
        """Image ``index`` with its depth in metres, both in raw pixels of :attr:`camera`.

        Raises:
            DatasetError: a file does not decode or has another size than the camera's.
        """
        ...

    def gravity(self, index: int) -> Floats | None:
        """Unit direction of gravity ``(3,)`` in the camera frame of image ``index``; None if the
        place does not record it."""
        ...


@runtime_checkable
class NumberedPlace(Place, Protocol):
    """A place whose images have numbers, of which a part can be taken."""

    def between(self, first: int, last: int) -> Place:
        """The images numbered ``first`` to ``last``, both included.

        Raises:
            DatasetError: there are none.
        """
        ...


class PlaceReader(Protocol):
    """Opens the folders of one layout.

    Attributes:
        name: the value of a source's ``reader`` setting.
        needs: the files it needs, worded for the user.
    """

    @property
    def name(self) -> str: ...
    @property
    def needs(self) -> str: ...

    def matches(self, folder: Path) -> bool:
        """True if ``folder`` appears to have this layout, complete or not."""
        ...

    def open(self, folder: Path) -> Place:
        """Open ``folder``.

        Raises:
            DatasetError: a file is missing or malformed, or there is no depth.
        """
        ...


_ReaderType = TypeVar("_ReaderType", bound=PlaceReader)
READERS: Registry[PlaceReader] = Registry(
    "reader of training data",
    package="slamdepth.training.readers",
    duplicate="two readers of training data are named '{name}'",
    error=ValueError,
)


def register_reader(reader_type: type[_ReaderType]) -> type[_ReaderType]:
    """Class decorator that registers a :class:`PlaceReader` under its name.

    Raises:
        ValueError: another reader has that name.
    """
    reader = reader_type()
    READERS.add(reader.name, reader, reader_type)
    return reader_type


def known_readers() -> dict[str, PlaceReader]:
    """The readers of this package, by name."""
    return {name: READERS.get(name) for name in READERS.names()}


def open_place(
    folder: Path, reader: str | None = None, more_readers: Mapping[str, PlaceReader] | None = None
) -> Place:
    """Open a folder of images with depth.

    Args:
        folder: ``NAME`` or, for images with numbers, ``NAME[FIRST-LAST]``: these only. So the places that
            one folder holds in the order of their numbers can be told apart.
        reader: name of the reader; None takes the first that matches the folder.
        more_readers: further readers, tried after those of this package.

    Raises:
        DatasetError: the folder is missing or of no known layout, there is no such
            reader, or the reader finds a file missing or malformed.
    """
    readers = {**known_readers(), **(more_readers or {})}
    if reader is not None and reader not in readers:
        raise DatasetError(f"unknown reader '{reader}' of training data; choose from: {', '.join(readers)}")
    folder, numbers = split_numbers(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder")
    try:
        found = reader or next((name for name in readers if readers[name].matches(folder)), None)
        if found is None:
            layouts = "; ".join(f"{name} ({known.needs})" for name, known in readers.items())
            raise DatasetError(f"{folder}: no known layout of training data; known are: {layouts}")
        place = readers[found].open(folder)
        if numbers is not None:
            if not isinstance(place, NumberedPlace):
                raise DatasetError(f"{folder}: its images have no numbers, so no part of it can be named")
            place = place.between(*numbers)
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror or error}") from error
    logger.info("%s: %d images with depth, read as '%s'", folder, len(place), found)
    for note in place.notes:
        logger.info("%s: %s", place.name, note)
    return place


def split_numbers(folder: Path) -> tuple[Path, tuple[int, int] | None]:
    """``NAME[FIRST-LAST]`` as the folder NAME and the two numbers; None where it names a whole folder."""
    named = _NUMBERS.fullmatch(folder.name)
    if named is None or folder.is_dir():
        return folder, None
    return folder.with_name(named["name"]), (int(named["first"]), int(named["last"]))


def data_folder(named: str) -> Path:
    """The folder ``named``, or that below ``$SLAMDEPTH_DATA`` if only that one exists.

    Environment variables and ``~`` are expanded.

    Raises:
        DatasetError: it does not exist.
    """
    path = Path(os.path.expandvars(named)).expanduser()
    root = os.environ.get("SLAMDEPTH_DATA")
    if not path.is_absolute() and root and not path.is_dir():
        path = Path(root) / path
    if not path.is_dir():
        hint = "looked below SLAMDEPTH_DATA" if root else "set SLAMDEPTH_DATA, or name it from here"
        raise DatasetError(f"{path}: no such folder of images with depth ({hint})")
    return path


def fingerprint(paths: Iterable[Path], *more: object) -> str:
    """Short hash of the names and sizes of files and of ``more``.

    Raises:
        OSError: a file is gone.
    """
    hashed = hashlib.sha256(repr(more).encode())
    for path in paths:
        hashed.update(f"{path.name}:{path.stat().st_size}\n".encode(errors="surrogateescape"))
    return hashed.hexdigest()[:16]
