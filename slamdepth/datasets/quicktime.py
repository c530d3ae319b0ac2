# SPDX-License-Identifier: Apache-2.0
"""The focal length in the metadata of an MP4 or QuickTime file.

Phones write it as ``com.apple.quicktime.camera.focal_length.35mm_equivalent`` among the metadata of the movie
or of its video track: an atom ``meta`` whose ``keys`` name entries and whose ``ilst`` holds their values
(Apple, "QuickTime File Format Specification", Metadata). Nothing else of the file is read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_LARGEST = 1 << 20
"""Bytes of an atom that is read as a whole; those of metadata have a few hundred."""
_MOST_ATOMS = 10_000
_TO_METADATA = {b"moov": (b"meta", b"trak", b"udta"), b"trak": (b"meta", b"udta"), b"udta": (b"meta",)}
_INTEGERS = {21: None, 22: None, 65: 1, 66: 2, 67: 4, 74: 8, 75: 1, 76: 2, 77: 4, 78: 8}
_UNSIGNED = (22, 75, 76, 77, 78)


def video_focal_35mm(path: Path) -> float | None:
    """Focal length in millimetres that a lens with the same view would have on 35 mm film; None where the
    file does not say, is of another format, or is damaged."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            for start, end in _metadata(file, 0, size, (b"moov",)):
                value = _value(file, start, end)
                if value is not None and 1.0 <= value <= 1000.0:
                    return value
    except (OSError, struct.error, ValueError, OverflowError):
        return None
    return None


def _atoms(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Name, start and end of the content of each atom between two places."""
    for _ in range(_MOST_ATOMS):
        if end - start < 8:
            return
        file.seek(start)
        size, name = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            size, head = struct.unpack(">Q", file.read(8))[0], 16
        elif size == 0:  # to the end of the file
            size = end - start
        if size < head or start + size > end:
            return
        yield name, start + head, start + size
        start += size


def _metadata(file: BinaryIO, start: int, end: int, wanted: tuple[bytes, ...]) -> Iterator[tuple[int, int]]:
    for name, first, last in _atoms(file, start, end):
        if name not in wanted:
            continue
        if name == b"meta":
            yield first, last
        else:
            yield from _metadata(file, first, last, _TO_METADATA[name])


def _value(file: BinaryIO, start: int, end: int) -> float | None:
    """The focal length in one ``meta`` atom."""
    # MP4 has a version and flags before the atoms inside, QuickTime has not
    for inside in (start, start + 4):
        parts = {name: (first, last) for name, first, last in _atoms(file, inside, end)}
        if b"keys" in parts and b"ilst" in parts:
            number = _number_of_key(_content(file, *parts[b"keys"]))
            if number is None:
                return None
            for name, first, last in _atoms(file, *parts[b"ilst"]):
                if name == struct.pack(">I", number):
                    return _of_data(_content(file, first, last))
    return None


def _content(file: BinaryIO, start: int, end: int) -> bytes:
    if end - start > _LARGEST:
        raise ValueError("an atom too large for metadata")
    file.seek(start)
    return file.read(end - start)


def _number_of_key(keys: bytes) -> int | None:
    """Which of the entries, from 1, is the focal length."""
    at, number = 8, 1  # after version, flags and count
    while at + 8 <= len(keys):
        size = struct.unpack_from(">I", keys, at)[0]
        if size < 8:
            return None
        if keys[at + 8 : at + size] == _KEY:
            return number
        at, number = at + size, number + 1
    return None


def _of_data(entry: bytes) -> float | None:
    """The number in an entry of ``ilst``, which holds one atom ``data``: type, locale, value."""
    if len(entry) < 16 or entry[4:8] != b"data":
        return None
    size, kind = struct.unpack(">I4xI", entry[:12])
    value = entry[16:size]
    if kind == 1:
        return float(value.decode("utf-8"))
    if kind == 23:
        return float(struct.unpack(">f", value)[0])
    if kind == 24:
        return float(struct.unpack(">d", value)[0])
    if kind in _INTEGERS and value and len(value) in (_INTEGERS[kind] or len(value),) and len(value) <= 8:
        return float(int.from_bytes(value, "big", signed=kind not in _UNSIGNED))
    return None
