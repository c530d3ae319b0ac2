# SPDX-License-Identifier: Apache-2.0
"""Sequence layouts by name, and :func:`open_dataset`, which finds the one a folder has.

A layout is one file in ``slamdepth/datasets/readers/`` with a class under
``@register_reader``; the files are imported when the first sequence is opened.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from slamdepth.calibration import CAMERA_FILE
from slamdepth.datasets.addresses import without_secret
from slamdepth.datasets.base import Dataset
from slamdepth.datasets.confinement import check_confined, refuse_archive
from slamdepth.datasets.image_files import IMAGE_ENDINGS
from slamdepth.datasets.intrinsics import CameraSource, Certainty
from slamdepth.datasets.options import ReadOptions
from slamdepth.datasets.video import VIDEO_ENDINGS, videos_in
from slamdepth.datasets.virtual_view import through_view
from slamdepth.errors import DatasetError
from slamdepth.registry import Registry
from slamdepth.types import Camera

_log = logging.getLogger(__name__)


class Reader(Protocol):
    """Opens the sequences of one layout.

    Attributes:
        name: short name of the layout.
        needs: the files it needs, as a user should read them.
    """

    name: str
    needs: str

    def matches(self, path: Path) -> bool:
        """True where ``path``, a folder or file, is meant to have this layout, whole or not."""
        ...

    def open(self, path: Path, camera: Camera | None) -> Dataset:
        """Open it; ``camera`` is what the user gave, or None.

        Raises:
            DatasetError: a file is missing or malformed.
            CameraError: the intrinsics are unknown.
        """
        ...


@runtime_checkable
class ReaderWithOptions(Reader, Protocol):
    """A reader that has a use for :class:`~slamdepth.datasets.options.ReadOptions`."""

    def open_with(self, path: Path, camera: Camera | None, options: ReadOptions) -> Dataset:
        """As :meth:`Reader.open`, which is called with default options.

        Raises:
            DatasetError, CameraError: as :meth:`Reader.open`.
        """
        ...


_ReaderType = TypeVar("_ReaderType", bound=Reader)
READERS: Registry[Reader] = Registry(
    "dataset reader",
    package="slamdepth.datasets.readers",
    duplicate="two dataset readers are named '{name}'",
    error=ValueError,
)
_last_reader: list[Reader] = []


def register_reader(reader_type: type[_ReaderType]) -> type[_ReaderType]:
    """Class decorator that makes a :class:`Reader` known to :func:`open_dataset`.

    Raises:
        ValueError: another reader has its name.
    """
    reader = reader_type()
    READERS.add(reader.name, reader, reader_type)
    return reader_type


def register_last_reader(reader_type: type[_ReaderType]) -> type[_ReaderType]:
    """Class decorator for the :class:`Reader` that :func:`open_dataset` asks where no layout matches.

    :func:`known_readers` leaves it out, for callers that read folders without a layout in their own way.
    """
    _last_reader[:] = [reader_type()]
    return reader_type


def known_readers() -> tuple[Reader, ...]:
    """The reader of every layout, sorted by name."""
    return tuple(READERS.get(name) for name in READERS.names())


def open_dataset(
    path: str | Path, camera_file: str | Path | None = None, options: ReadOptions | None = None
) -> Dataset:
    """Open a sequence, whatever its layout.

    Frames of a wide lens are pinhole views, see :class:`slamdepth.datasets.virtual_view.VirtualView`.

    Args:
        path: a folder, a video, a bag, a pattern of images such as ``img_*.png``, or a live source:
            ``camera:0``, or an address of RTSP or HTTP.
        camera_file: a ``camera.yaml`` that overrules what the folder says or is known for.
        options: what else is asked, such as the topic of a bag.

    Raises:
        DatasetError: it is missing, of no known layout, or its files are
            missing or malformed; names file and line.
        CameraError: the intrinsics are malformed, unknown, or of another image size.
    """
    path = Path(path).expanduser()
    options = options or ReadOptions()
    if "\0" in str(path):
        raise DatasetError(f"{str(path)[:80]!r}: no file has such a name")
    readers = (*known_readers(), *_last_reader)
    try:
        camera, camera_notes = None, list[str]()
        found = next((reader for reader in readers if reader.matches(path)), None)
        if found is None and not path.exists():
            what = (
                "video file" if path.suffix.lower() in VIDEO_ENDINGS else "file" if path.suffix else "folder"
            )
            raise DatasetError(f"{path}: no such {what}")
        if camera_file is not None:
            camera = Camera.from_file(Path(camera_file).expanduser(), camera_notes)
        if found is not None:
            _log.info("%s: reading as layout '%s'", without_secret(str(path)), found.name)
            dataset = _opened(found, path, camera, options)
            if camera_file is not None:
                dataset.camera_source = CameraSource(Certainty.GIVEN, "--camera")
            dataset.notes[:0] = camera_notes
            for note in dataset.notes:
                _log.info("%s: %s", dataset.name, note)
            return dataset
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    refuse_archive(path)
    if path.suffix.lower() in IMAGE_ENDINGS and path.is_file():
        raise DatasetError(
            f"{path}: is one image; name its folder, or take 'slamdepth depth' for its depth and 'slamdepth "
            "localize' for its place in a map"
        )
    if not path.is_dir():
        known = ", ".join(ending.removeprefix(".") for ending in VIDEO_ENDINGS)
        raise DatasetError(
            f"{path}: is a file; a sequence is a folder or a video ({known}), or another file that "
            "docs/inputs.md lists"
        )
    if inside := videos_in(path):
        camera_too = f" with --camera '{path / CAMERA_FILE}'" if (path / CAMERA_FILE).is_file() else ""
        raise DatasetError(
            f"{path}: no known sequence layout, but it holds {len(inside)} video{'s' * (len(inside) > 1)}: "
            f"name one, such as '{inside[0]}'{camera_too}"
        )
    if not any(path.iterdir()):
        raise DatasetError(f"{path}: is empty; name a video, a folder of images, or a data set")
    raise DatasetError(
        f"{path}: no known sequence layout: neither a folder of images, nor one of the "
        f"{len(known_readers())} layouts that docs/inputs.md lists"
    )


def _opened(reader: Reader, path: Path, camera: Camera | None, options: ReadOptions) -> Dataset:
    if isinstance(reader, ReaderWithOptions):
        dataset = reader.open_with(path, camera, options)
    else:
        dataset = reader.open(path, camera)
    if not options.follow_links:
        check_confined(dataset)
    dataset = through_view(dataset)
    dataset.layout = reader.name
    return dataset
