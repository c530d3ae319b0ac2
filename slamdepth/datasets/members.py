# SPDX-License-Identifier: Apache-2.0
"""Files of a recording that is a folder or one zip archive; an archive is read in place, never unpacked."""

from __future__ import annotations

import threading
import zipfile
from pathlib import Path

from slamdepth.errors import DatasetError

LARGEST_MEMBER = 64 * 1024 * 1024
"""Bytes; an image or the list of a long recording is smaller, what an archive bomb unpacks to is not."""
_MOST_MEMBERS = 2_000_000


class Members:
    """Names and bytes of the files of a recording.

    Args:
        path: a folder, or a zip archive of any ending.

    Attributes:
        names: relative to the folder, with ``/``.

    Raises:
        DatasetError: the archive is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._archive: zipfile.ZipFile | None = None
        if path.is_dir():
            self.names = frozenset(
                file.relative_to(path).as_posix()
                for pattern in ("*", "*/*")
                for file in path.glob(pattern)
                if file.is_file()
            )
            return
        try:
            self._archive = zipfile.ZipFile(path)
            infos = self._archive.infolist()
        except Exception as error:  # zipfile lets even IndexError out where an archive is damaged
            raise DatasetError(
                f"{path}: this archive cannot be read (is it whole?): {_line(error)}"
            ) from error
        if len(infos) > _MOST_MEMBERS:
            raise DatasetError(f"{path}: this archive has {len(infos)} files, more than any recording")
        self.names = frozenset(info.filename for info in infos if info.filename and not info.is_dir())

    def read(self, name: str, largest: int = LARGEST_MEMBER) -> bytes:
        """The bytes of a file.

        Raises:
            DatasetError: there is no such file, it is damaged, or larger than ``largest`` bytes.
        """
        if name not in self.names:
            raise DatasetError(f"{self.path}: has no file {name}")
        try:
            if self._archive is None:
                with (self.path / name).open("rb") as file:
                    data = file.read(largest + 1)
            else:
                # What the archive says of the size may be a lie: no more is unpacked than is asked for.
                with self._lock, self._archive.open(name) as member:
                    data = member.read(largest + 1)
        except Exception as error:  # see above; also of zlib, LZMA and BZ2
            raise DatasetError(f"{self.path}: {name} cannot be read: {_line(error)}") from error
        if len(data) > largest:
            raise DatasetError(f"{self.path}: {name} has more than {largest} bytes")
        return data


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
