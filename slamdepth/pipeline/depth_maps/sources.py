# SPDX-License-Identifier: Apache-2.0
"""What depth maps are made of: an image, a folder of images, a video or a known sequence.

Each is a :class:`Source`: shots in order, each read only when it is needed, so that finished shots cost
nothing and memory does not grow with the length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from slamdepth.datasets import Dataset, ReadOptions, known_readers, open_dataset
from slamdepth.datasets.image_files import IMAGE_ENDINGS, list_images, read_image_frame, short_names
from slamdepth.datasets.intrinsics import (
    Certainty,
    Intrinsics,
    find_camera_file,
    intrinsics_of,
    tell_guess,
)
from slamdepth.datasets.orientation import fitted_camera
from slamdepth.datasets.video import VIDEO_ENDINGS, VideoFile
from slamdepth.datasets.virtual_view import as_pinhole
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.pipeline.sequence_id import sequence_id
from slamdepth.training.data import fingerprint
from slamdepth.training.readers.pairs import PairPlace, PairReader
from slamdepth.types import Camera, Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class SourceKind(str, Enum):
    """What the user named."""

    IMAGE = "image"
    IMAGES = "folder of images"
    PAIRS = "folder of training pairs"
    VIDEO = "video"
    SEQUENCE = "sequence"


@dataclass(frozen=True)
class Shot:
    """One image to come.

    Attributes:
        name: of its output files, unique in its source.
        origin: the file or frame it is, for a reader.
        stamp: changes when the image behind it changes; empty where that is not known.
        read: decodes it; to be called before the next shot is asked for. Raises
            ImageDecodeError, and CameraError where its size is not the camera's.
    """

    name: str
    origin: str
    stamp: str
    read: Callable[[], tuple[Frame, Intrinsics]]


class Source(Protocol):
    """Shots in order.

    Attributes:
        kind, name: what it is, and its short name.
        fps: shots per second, None where they are single images.
        camera: of all shots, None where it is unknown or guessed.
        has_depth: True where frames may carry sensor depth.
        stamp: differs for another source of the same name.
        notes: what was guessed or repaired, one line each.
    """

    kind: SourceKind
    name: str
    fps: float | None
    camera: Camera | None
    has_depth: bool
    stamp: str
    notes: list[str]

    def __len__(self) -> int:
        """Number of shots; of a video what the file says, 0 = does not say."""
        ...

    def shots(self, *, with_depth: bool = False) -> Iterator[Shot]:
        """The shots in order; with ``with_depth`` their frames carry sensor depth where there is some."""
        ...


def open_source(
    path: Path,
    *,
    camera_file: Path | None,
    stride: int,
    max_frames: int | None,
    reading: ReadOptions | None = None,
) -> Source:
    """Find out what ``path`` is and open it.

    Args:
        camera_file: a ``camera.yaml`` that overrules whatever else is known of the camera.
        stride, max_frames: every Nth image, and at most this many.
        reading: how a sequence is opened.

    Raises:
        DatasetError: nothing is there, or nothing in it can be read.
        CameraError: a camera file is malformed or of another image size.
    """
    path = path.expanduser()
    chosen = slice(None, None if max_frames is None else max_frames * stride, stride)
    try:
        if path.is_dir():
            if any(reader.matches(path) for reader in known_readers()):
                return _SequenceSource(open_dataset(path, camera_file, reading), chosen)
            if (path / "camera.json").is_file():
                return _PairSource(PairReader().open(path), camera_file, chosen)
            return _ImageSource(SourceKind.IMAGES, path, list_images(path)[chosen], camera_file)
        if not path.exists():
            raise DatasetError(f"{path}: no such file or folder")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    if path.suffix.lower() in VIDEO_ENDINGS:
        return _VideoSource(VideoFile(path), camera_file, chosen)
    if path.suffix.lower() in IMAGE_ENDINGS:
        return _ImageSource(SourceKind.IMAGE, path, [path], camera_file)
    if any(reader.matches(path) for reader in known_readers()):  # a bag, say
        return _SequenceSource(open_dataset(path, camera_file, reading), chosen)
    known = ", ".join(ending.removeprefix(".") for ending in (*IMAGE_ENDINGS, *VIDEO_ENDINGS))
    raise DatasetError(f"{path}: neither a folder nor an image nor a video by its ending; known are {known}")


class _ImageSource:
    fps: float | None = None
    has_depth = False

    def __init__(self, kind: SourceKind, path: Path, images: list[Path], camera_file: Path | None) -> None:
        self.kind = kind
        self.notes: list[str] = []
        self.name = path.stem if kind is SourceKind.IMAGE else path.resolve().name
        self.stamp = fingerprint((), str(path.resolve()))
        self._images = images
        self._given = find_camera_file(path.parent if kind is SourceKind.IMAGE else path, camera_file)
        self.camera = None if self._given is None else self._given[0]

    def __len__(self) -> int:
        return len(self._images)

    def shots(self, *, with_depth: bool = False) -> Iterator[Shot]:
        names = short_names(self._images)
        for index, (path, name) in enumerate(zip(self._images, names, strict=True)):
            yield Shot(name, path.name, _stamp(path), partial(read_image_frame, path, index, self._given))


class _VideoSource:
    kind = SourceKind.VIDEO
    has_depth = False

    def __init__(self, video: VideoFile, camera_file: Path | None, chosen: slice) -> None:
        self.name = video.path.stem
        self.stamp = _stamp(video.path)
        self.notes = list(video.notes)
        self._stride = chosen.step
        self._max_frames = None if chosen.stop is None else chosen.stop // self._stride
        self.fps = video.fps / self._stride
        self._video = video
        # A camera.yaml in the folder of a video may be another's: it must be named.
        given = None if camera_file is None else find_camera_file(video.path.parent, camera_file)
        self.camera = None if given is None else given[0]
        if given is None:
            self._intrinsics = intrinsics_of(video.width, video.height)
        else:
            size = (video.height, video.width)
            self.camera = fitted_camera(video.path, size, given[0], video.orientation, [])
            self._intrinsics = Intrinsics(self.camera, given[1], Certainty.GIVEN)

    def __len__(self) -> int:
        named: int = -(-self._video.frames_named // self._stride)
        return named if self._max_frames is None else min(named or self._max_frames, self._max_frames)

    def shots(self, *, with_depth: bool = False) -> Iterator[Shot]:
        index = -1
        for count, (index, decode) in enumerate(self._video.frames(self._stride)):
            if count == self._max_frames:
                return
            yield _numbered(index, partial(self._read, index, decode))
        note = self._video.missing_note(index + 1) if self._stride == 1 else ""
        if note and note not in self.notes:
            self.notes.append(note)

    def _read(self, index: int, decode: Callable[[], NDArray[np.uint8]]) -> tuple[Frame, Intrinsics]:
        frame = as_pinhole(Frame(index, index / self._video.fps, decode(), self._intrinsics.camera))
        return frame, replace(self._intrinsics, camera=frame.camera)


class _PairSource:
    """Training pairs, whose depth images are no colour images."""

    kind = SourceKind.PAIRS
    fps: float | None = None
    has_depth = True

    def __init__(self, place: PairPlace, camera_file: Path | None, chosen: slice) -> None:
        self.name = place.name
        self.stamp = place.fingerprint
        self.notes: list[str] = []
        self._place = place
        self._indices = range(len(place))[chosen]
        given = None if camera_file is None else find_camera_file(place.images[0].parent, camera_file)
        self._intrinsics = Intrinsics(*(given or (place.camera, "camera.json of the pairs")), Certainty.GIVEN)
        self.camera: Camera | None = self._intrinsics.camera

    def __len__(self) -> int:
        return len(self._indices)

    def shots(self, *, with_depth: bool = False) -> Iterator[Shot]:
        for index in self._indices:
            path = self._place.images[index]
            yield Shot(path.stem, path.name, _stamp(path), partial(self._read, index))

    def _read(self, index: int) -> tuple[Frame, Intrinsics]:
        try:
            frame = self._place.read(index)
        except DatasetError as error:
            raise ImageDecodeError(str(error)) from error
        return replace(frame, camera=self._intrinsics.camera), self._intrinsics


class _SequenceSource:
    kind = SourceKind.SEQUENCE

    def __init__(self, dataset: Dataset, chosen: slice) -> None:
        self.name = dataset.name
        self.stamp = sequence_id(dataset)
        self.notes = list(dataset.notes)
        self.camera: Camera | None = dataset.camera
        self.has_depth = dataset.has_depth
        self.fps: float | None = dataset.camera.fps / chosen.step
        self._indices = range(len(dataset))[chosen]
        self._dataset = dataset
        source = dataset.camera_source
        tell_guess(dataset.name, source)
        how = "the sequence's own camera" if source.certainty is Certainty.GIVEN else source.how
        self._intrinsics = Intrinsics(dataset.camera, how, source.certainty)

    def __len__(self) -> int:
        return len(self._indices)

    def shots(self, *, with_depth: bool = False) -> Iterator[Shot]:
        for index in self._indices:
            yield _numbered(index, partial(self._read, index, with_depth))

    def _read(self, index: int, with_depth: bool) -> tuple[Frame, Intrinsics]:
        return self._dataset.read(index, with_depth=with_depth), self._intrinsics


def _numbered(index: int, read: Callable[[], tuple[Frame, Intrinsics]]) -> Shot:
    return Shot(f"frame-{index:06d}", f"frame {index}", "", read)


def _stamp(path: Path) -> str:
    try:
        found = path.stat()
    except OSError:  # reading it will say so
        return ""
    return f"{found.st_size} bytes of {found.st_mtime_ns} ns"
