# SPDX-License-Identifier: Apache-2.0
"""Arrays on disk that grow group by group and stay consistent if the writer is killed at any moment.

Samples are flushed to disk before they are marked as done, so a sample marked as done is complete
even after a power failure. The grouping does not depend on what was done before: a network's output
for an image can depend on the rest of its batch.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import OutputError
from slamdepth.io import write_text

logger = logging.getLogger(__name__)

_NOTE = "shapes.json"
_SPARE_BYTES = 64 << 20
_COMMIT_EVERY_S = 2.0

Spec = tuple[tuple[int, ...], type]
"""Shape of one sample, and its type."""


def bytes_per_sample(specs: Mapping[str, Spec]) -> int:
    """Size of one sample on disk, in bytes."""
    return sum(
        int(np.prod(shape, dtype=np.int64)) * np.dtype(kind).itemsize for shape, kind in specs.values()
    )


def done_on_disk(folder: Path, count: int, specs: Mapping[str, Spec]) -> int:
    """How many of ``count`` samples are done in ``folder``; nothing is changed."""
    if not _is_ours(folder, count, specs):
        return 0
    return int(np.count_nonzero(np.load(folder / "done.npy", mmap_mode="r")))


class SampleStore:
    """``count`` samples in ``folder``, with one memory-mapped file per array.

    Args:
        specs: shape and type of each array's sample.

    Raises:
        OutputError: the folder cannot be written or the disk is too small.
    """

    def __init__(self, folder: Path, count: int, specs: Mapping[str, Spec]) -> None:
        self.folder = folder
        is_fresh = not _is_ours(folder, count, specs)
        todo = count if is_fresh else count - done_on_disk(folder, count, specs)
        _check_free_space(folder, todo * bytes_per_sample(specs))
        if is_fresh:
            (folder / _NOTE).unlink(missing_ok=True)
        self.arrays: dict[str, Any] = {
            name: np.lib.format.open_memmap(
                folder / f"{name}.npy",
                mode="w+" if is_fresh else "r+",
                dtype=kind if is_fresh else None,
                shape=(count, *shape) if is_fresh else None,
            )
            for name, (shape, kind) in _all(specs).items()
        }
        self._written: list[range] = []
        self._committed_at_s = time.monotonic()
        if is_fresh:  # last: where it stands, every file is there in full length
            write_text(folder / _NOTE, _shapes(count, specs))

    def groups_to_do(self, size: int) -> list[range]:
        """Groups of ``size`` consecutive samples that are not all done."""
        done = self.arrays["done"]
        groups = [range(start, min(start + size, len(done))) for start in range(0, len(done), size)]
        return [group for group in groups if not done[group.start : group.stop].all()]

    def put(self, group: range, **values: Any) -> None:
        """Write the samples ``group`` of every array, ``(len(group), ...)`` each.

        They count as done after the next :meth:`commit`, which also happens every few seconds.

        Raises:
            ValueError: a value has another shape; nothing is written.
        """
        for name, value in values.items():
            expected = (len(group), *self.arrays[name].shape[1:])
            if np.shape(value) != expected:
                raise ValueError(f"{self.folder}: '{name}' is {np.shape(value)}, not {expected}")
        for name, value in values.items():
            self.arrays[name][group.start : group.stop] = value
        self._written.append(group)
        if time.monotonic() - self._committed_at_s > _COMMIT_EVERY_S:
            self.commit()

    def commit(self) -> None:
        """Wait until everything written is on disk, then mark it as done."""
        if self._written:
            for name, array in self.arrays.items():
                if name != "done":
                    array.flush()
            for group in self._written:
                self.arrays["done"][group.start : group.stop] = 1
            self.arrays["done"].flush()
        self._written.clear()
        self._committed_at_s = time.monotonic()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make ``folder`` and hold an exclusive lock on it; the lock ends with the process.

    Raises:
        OutputError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    try:
        _lock(handle, folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        logger.warning("%s: another training writes here; waiting for it", folder)
        fcntl.flock(handle, fcntl.LOCK_EX)


def _all(specs: Mapping[str, Spec]) -> dict[str, Spec]:
    return {**specs, "done": ((), np.uint8)}


def _shapes(count: int, specs: Mapping[str, Spec]) -> str:
    return json.dumps({name: [count, *shape] for name, (shape, _) in _all(specs).items()})


def _is_ours(folder: Path, count: int, specs: Mapping[str, Spec]) -> bool:
    """True if every array is there, complete, with these shapes and types."""
    try:
        if (folder / _NOTE).read_text(encoding="utf-8") != _shapes(count, specs):
            return False
        for name, (shape, kind) in _all(specs).items():
            found = np.load(folder / f"{name}.npy", mmap_mode="r")
            if found.shape != (count, *shape) or found.dtype != kind:
                return False
    except (OSError, ValueError):  # missing or cut short
        return False
    return True


def _check_free_space(folder: Path, needed_bytes: int) -> None:
    """Check before: a full disk under a memory map kills the process without a message."""
    free = shutil.disk_usage(folder).free
    if needed_bytes and needed_bytes + _SPARE_BYTES > free:
        raise OutputError(
            f"{folder}: the features need {needed_bytes / 1e9:.2f} GB and {free / 1e9:.2f} GB are free; "
            "set SLAMDEPTH_CACHE to a larger disk or lower the places' 'samples'"
        )
