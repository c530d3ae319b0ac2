# SPDX-License-Identifier: Apache-2.0
"""A temporary file for arrays that do not fit into the memory budget."""

from __future__ import annotations

import logging
import tempfile
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from slamdepth.mapping.codec import Encoded

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Extent:
    """A range of bytes of the file."""

    start: int
    length: int


class SpillFile:
    """A temporary file without a name: nothing is left of it however the process ends.

    Where the disk takes no more, bytes stay in memory. Safe to use from any thread.

    Attributes:
        size: bytes written.
    """

    def __init__(self) -> None:
        self._file: Any = None
        self._lock = threading.Lock()
        self._has_failed = False
        self.size = 0

    def spill(self, encoded: Encoded) -> SpilledArray:
        """Write an encoded array; returns the handle that reads it back."""
        return SpilledArray(self, self._put(encoded.data), encoded.decode)

    def _put(self, data: bytes) -> _Extent | bytes:
        with self._lock:
            try:
                if self._file is None:
                    self._file = tempfile.TemporaryFile(prefix="slamdepth-", buffering=0)  # noqa: SIM115
                    weakref.finalize(self, self._file.close)
                self._file.seek(self.size)
                if self._file.write(data) != len(data):
                    raise OSError("the disk is full")
            except OSError as error:
                level = logging.DEBUG if self._has_failed else logging.WARNING
                log.log(level, "keyframes stay in memory: no temporary file can be written: %s", error)
                self._has_failed = True
                return data
            extent = _Extent(self.size, len(data))
            self.size += len(data)
            return extent

    def read(self, place: _Extent | bytes) -> bytes:
        """The bytes of one array."""
        if isinstance(place, bytes):
            return place
        with self._lock:
            self._file.seek(place.start)
            return bytes(self._file.read(place.length))


@dataclass(frozen=True)
class SpilledArray:
    """An encoded array in a file, or in memory where the file could not take it."""

    _file: SpillFile
    _place: _Extent | bytes
    _decode: Callable[[bytes], NDArray[Any]]

    def load(self) -> NDArray[Any]:
        """Read and decode the array."""
        return self.encoded().array()

    def encoded(self) -> Encoded:
        """The array as it was written."""
        return Encoded(self._file.read(self._place), self._decode)
