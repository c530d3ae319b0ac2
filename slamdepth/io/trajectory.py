# SPDX-License-Identifier: Apache-2.0
"""Writing of TUM trajectory files: ``timestamp tx ty tz qx qy qz qw``, camera to world, w >= 0."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import OutputError
from slamdepth.io.text import write_text
from slamdepth.types import Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

TUM_HEADER = "# timestamp_s tx ty tz qx qy qz qw (metres, camera to world)\n"

_FSYNC_EVERY_S = 1.0


def write_tum_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory, whole or not at all.

    Times survive exactly; positions and quaternions have ten significant digits.

    Raises:
        OutputError: ``path`` cannot be written.
        ValueError: a pose or a time is not finite.
    """
    lines = map(format_tum_row, trajectory.timestamps_s.tolist(), trajectory.T_world_camera)
    write_text(path, TUM_HEADER + "".join(lines))


class TrajectoryWriter:
    """A TUM trajectory file that grows line by line and survives the process's death.

    Each line reaches the operating system in one write, so a killed process leaves whole
    lines; the disk is synchronised at most once a second, so a power cut costs about that.

    Args:
        path: file to create; an existing one is emptied.

    Raises:
        OutputError: from the constructor and from :meth:`append`, ``path`` cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._last_timestamp_s = -math.inf
        self._synced_at_s = time.monotonic()
        try:
            self._file = self.path.open("wb", buffering=0)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        self._write(TUM_HEADER)

    def append(self, timestamp_s: float, T_world_camera: NDArray[np.float64]) -> None:
        """Add one ``(4, 4)`` pose, camera to world, at ``timestamp_s`` seconds.

        Raises:
            OutputError: the file cannot be written (a full disk, say).
            ValueError: the pose is no finite ``(4, 4)``, the time does not increase, or
                the writer is closed.
        """
        if timestamp_s <= self._last_timestamp_s:
            raise ValueError(f"times must increase: {timestamp_s!r} after {self._last_timestamp_s!r}")
        self._write(format_tum_row(timestamp_s, T_world_camera))
        self._last_timestamp_s = timestamp_s
        now_s = time.monotonic()
        if now_s - self._synced_at_s >= _FSYNC_EVERY_S:
            self._sync()
            self._synced_at_s = now_s

    def comment(self, text: str) -> None:
        """Add a line that readers of trajectories skip.

        Args:
            text: one line of ASCII, without the leading ``#``.

        Raises:
            OutputError: the file cannot be written.
            ValueError: ``text`` has more than one line, or the writer is closed.
        """
        if "\n" in text:
            raise ValueError(f"a comment is one line, got {text!r}")
        self._write(f"# {text}\n")

    def close(self) -> None:
        """Synchronise with the disk and close; a second call does nothing."""
        if not self._file.closed:
            try:
                self._sync()
            finally:
                self._file.close()

    def _write(self, text: str) -> None:
        data = text.encode("ascii")
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def _sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def format_timestamp(timestamp_s: float) -> str:
    """Seconds as a decimal with six or more places that reads back exactly."""
    return np.format_float_positional(timestamp_s, unique=True, min_digits=6)


def format_tum_row(timestamp_s: float, T_world_camera: NDArray[np.float64]) -> str:
    """One TUM line, with its newline, of a ``(4, 4)`` pose.

    Raises:
        ValueError: the pose is no finite ``(4, 4)`` or the time is not finite.
    """
    from scipy.spatial.transform import Rotation

    T = np.asarray(T_world_camera, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not math.isfinite(timestamp_s):
        raise ValueError(f"a finite (4, 4) pose and time are needed, got {timestamp_s!r} and {T!r}")
    quat_xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    numbers = " ".join(f"{value:.10g}" for value in (*T[:3, 3].tolist(), *quat_xyzw.tolist()))
    return f"{format_timestamp(timestamp_s)} {numbers}\n"
