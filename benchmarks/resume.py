# SPDX-License-Identifier: Apache-2.0
"""Long benchmarks that go on where they stopped: rows in a file, each computed once."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import slamdepth
from benchmarks.record import read_benchmark, write_benchmark
from slamdepth.errors import OutputError


def code_sha256() -> str:
    """Digest of the package's source, which tells two states of a checkout apart that share a commit."""
    root = Path(slamdepth.__file__).parent
    hashed = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        hashed.update(f"{file.relative_to(root)}\n".encode())
        hashed.update(file.read_bytes())
    return hashed.hexdigest()[:16]


class RowFile:
    """The rows of a benchmark, written after each one.

    Args:
        path: the JSON file; None keeps the rows in memory. A file of the same settings and the same source
            of slamdepth is continued.
        begun: :func:`benchmarks.record.environment`, before the first run.
        settings: what decides the figures of a row.
        keys: the entries of a row that say what it is of.

    Raises:
        InputError: the file is none of this program.
        OutputError: it holds rows of other settings or of other source.
    """

    def __init__(
        self, path: Path | None, begun: dict[str, Any], settings: dict[str, Any], keys: Sequence[str]
    ) -> None:
        self._path, self._begun, self._keys = path, begun, tuple(keys)
        self._settings = {**settings, "source_sha256": code_sha256()}
        self.rows: list[dict[str, Any]] = []
        if path is not None and path.is_file():
            found = read_benchmark(path)
            differing = [key for key, value in self._settings.items() if found["settings"].get(key) != value]
            if differing:
                raise OutputError(
                    f"{path}: holds rows of another benchmark ({', '.join(differing)} differ); name another "
                    "file or delete this one"
                )
            self.rows = list(found["rows"])

    def find(self, **key: Any) -> dict[str, Any] | None:
        """The row of these ``keys``, None where it is not computed yet."""
        return next((row for row in self.rows if self._matches(row, key)), None)

    def add(self, row: dict[str, Any]) -> None:
        """Append a row and write the file.

        Raises:
            OutputError: the file cannot be written.
        """
        self.rows.append(row)
        if self._path is not None:
            write_benchmark(self._path, self._begun, self._settings, rows=self.rows)

    def _matches(self, row: dict[str, Any], key: dict[str, Any]) -> bool:
        return all(row.get(name) == key.get(name) for name in self._keys)
