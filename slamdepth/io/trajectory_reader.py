# SPDX-License-Identifier: Apache-2.0
"""Reading of trajectory files: TUM's, and others whose header says what their columns are.

Without a header a line is ``timestamp tx ty tz qx qy qz qw``, camera to world.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.io.columns import TUM_COLUMNS, Columns, find_columns
from slamdepth.io.text import parse_float, read_commented_lines
from slamdepth.io.times import (
    TimeColumn,
    TimeUnit,
    UnitVerdict,
    conversion_notes,
    judge_unit,
    settle_unit,
)
from slamdepth.types import Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

_KITTI_COLUMNS = 12


@dataclass(frozen=True)
class _Poses:
    """A trajectory file whose times have no unit yet; ``table`` is ``(N, 7)`` x y z qx qy qz qw."""

    path: Path
    times: TimeColumn
    table: NDArray[np.float64]
    notes: list[str]

    def verdict(self) -> UnitVerdict:
        return judge_unit(self.times, of_images=False)

    def trajectory(self, verdict: UnitVerdict) -> tuple[Trajectory, list[str]]:
        times_s = self.times.seconds(unit_of(self.path, self.times, verdict))
        T_world_camera = np.tile(np.eye(4), (len(self.table), 1, 1))
        largest = np.abs(self.table[:, 3:]).max(axis=1, keepdims=True)
        T_world_camera[:, :3, :3] = _rotations(self.table[:, 3:] / largest)  # so that norms cannot overflow
        T_world_camera[:, :3, 3] = self.table[:, :3]
        notes = [*self.notes, *conversion_notes(self.path.name, self.times, verdict)]
        return Trajectory(times_s, T_world_camera), notes


def read_tum_trajectory(
    path: str | Path, reference_s: NDArray[np.float64] | None = None
) -> tuple[Trajectory, list[str]]:
    """Read a trajectory of ``timestamp tx ty tz qx qy qz qw`` lines, camera to world.

    Separators are white space, commas or semicolons. A header, such as EuRoC's, may name other columns and
    units. Times in milliseconds, microseconds or nanoseconds are converted to seconds. Rows with NaN,
    infinity or a zero quaternion and rows that repeat the time before them are dropped; quaternions are
    normalised.

    Args:
        reference_s: times ``(M,)`` in seconds of the same recording, which help where the unit is not clear.

    Returns:
        The trajectory, and one line for each conversion and each kind of repair with its count.

    Raises:
        DatasetError: the file is missing, a line is malformed or its time decreases (the line is named), its
            header names no poses, its times fit no unit, or no pose is left.
    """
    poses = _read(Path(path))
    return poses.trajectory(settle_unit(poses.times, poses.verdict(), reference_s))


def read_trajectory_pair(
    first: str | Path, second: str | Path
) -> tuple[tuple[Trajectory, list[str]], tuple[Trajectory, list[str]]]:
    """Read two trajectories of one recording, as :func:`read_tum_trajectory` reads each.

    Where the unit of one's times is not clear, the other decides.

    Raises:
        DatasetError: as of :func:`read_tum_trajectory`.
    """
    poses = (_read(Path(first)), _read(Path(second)))
    verdicts = [each.verdict() for each in poses]
    order = (1, 0) if verdicts[1].is_sure and not verdicts[0].is_sure else (0, 1)
    leader, follower = (poses[index] for index in order)
    leading = leader.trajectory(verdicts[order[0]])
    settled = settle_unit(follower.times, verdicts[order[1]], leading[0].timestamps_s)
    following = follower.trajectory(settled)
    return (leading, following) if order == (0, 1) else (following, leading)


def unit_of(path: Path, times: TimeColumn, verdict: UnitVerdict) -> TimeUnit:
    """The unit of ``verdict``.

    Raises:
        DatasetError: it has none.
    """
    if verdict.unit is None:
        raise DatasetError(
            f"{path}: times such as {times.texts[0]}, {times.step:g} apart, are neither seconds, "
            "milliseconds, microseconds nor nanoseconds: write them in seconds"
        )
    return verdict.unit


def _read(path: Path) -> _Poses:
    lines = read_commented_lines(path)
    columns, lines = _columns(path, lines)
    texts: list[str] = []
    rows: list[list[float]] = []
    invalid = repeated = 0
    has_commas = False
    for number, line in lines:
        text, row = _parse(path, number, line, columns)
        has_commas = has_commas or "," in line
        if not all(map(math.isfinite, row)) or max(map(abs, row[4:])) < 1e-6:
            invalid += 1
        elif rows and row[0] == rows[-1][0]:
            repeated += 1
        elif rows and row[0] < rows[-1][0]:
            raise DatasetError(
                f"{path}:{number}: time {row[0]!r} comes after {rows[-1][0]!r}: sort the file by time"
            )
        else:
            texts.append(text)
            rows.append(row)
    if not rows:
        raise DatasetError(f"{path}: holds no valid pose ({invalid} rows with NaN or a zero quaternion)")
    table = np.array(rows, dtype=np.float64)[:, 1:]
    table[:, :3] *= columns.metres_per_unit if columns is not None else 1.0
    largest = np.abs(table[:, 3:]).max(axis=1)
    with np.errstate(over="ignore"):  # infinity is no length of 1 either
        lengths = np.linalg.norm(table[:, 3:] / largest[:, None], axis=1) * largest
    counted = {
        "rows with NaN, infinity or a zero quaternion dropped": invalid,
        "rows with the time of the row before dropped": repeated,
        "quaternions whose length is not 1 normalised": int(np.count_nonzero(np.abs(lengths - 1.0) > 0.05)),
    }
    notes = [f"{path.name}: {count} {what}" for what, count in counted.items() if count]
    times = TimeColumn(tuple(texts), columns.time_unit if columns is not None else None)
    return _Poses(path, times, table, [*_column_notes(path, columns, times, has_commas), *notes])


def _columns(path: Path, lines: list[tuple[int, str]]) -> tuple[Columns | None, list[tuple[int, str]]]:
    """The columns by the header, or None, and the lines of data."""
    data = [(number, line) for number, line in lines if not line.startswith("#")]
    if not data:
        return None, data
    headers = [line for number, line in lines if number < data[0][0]]
    if len(data) > 1 and _is_header(data[0][1]):
        headers.append(data[0][1])
        data = data[1:]
        found = find_columns(path, headers, len(_fields(data[0][1])))
        if found is None:  # no header after all: name the malformed line
            return None, [(number, line) for number, line in lines if not line.startswith("#")]
        return found, data
    return find_columns(path, headers, len(_fields(data[0][1]))), data


def _is_header(line: str) -> bool:
    fields = _fields(line)
    return len(fields) >= TUM_COLUMNS.count and re.match(r"[\"'%]?[A-Za-z]", fields[0]) is not None


def _parse(path: Path, number: int, line: str, columns: Columns | None) -> tuple[str, list[float]]:
    """The time as it is written, and time, position and quaternion x y z w."""
    fields = _fields(line)
    wanted = columns or TUM_COLUMNS
    try:
        if len(fields) != wanted.count:
            raise ValueError
        return fields[wanted.time], [parse_float(fields[index]) for index in wanted.indices]
    except ValueError as error:
        expected = (
            "eight numbers 'timestamp tx ty tz qx qy qz qw'"
            if columns is None
            else f"{wanted.count} columns as the header says, with numbers for '{wanted.order}'"
        )
        hint = ""
        if columns is None and len(fields) == _KITTI_COLUMNS:
            hint = "; twelve are a pose of KITTI, which has no time: convert it"
        elif columns is None and len(fields) > wanted.count:
            hint = (
                "; more are read where a first line names them, such as EuRoC's '#timestamp [ns],p_RS_R_x...'"
            )
        raise DatasetError(f"{path}:{number}: expected {expected}, found {line[:80]!r}{hint}") from error


def _fields(line: str) -> list[str]:
    return re.split(r"[\s,;]+", line.strip(" \t,;"))


def _column_notes(path: Path, columns: Columns | None, times: TimeColumn, has_commas: bool) -> list[str]:
    if columns is None:
        if not has_commas or judge_unit(times, of_images=False).unit is not TimeUnit.NANOSECONDS:
            return []
        return [
            f"{path.name}: no header names the columns; quaternions are read as x y z w, but EuRoC's files "
            "of this kind have w first: check"
        ]
    notes = []
    if columns.indices != TUM_COLUMNS.indices:
        further = columns.count - len(columns.indices)
        rest = f"; {further} further columns are left out" if further else ""
        notes.append(f"{path.name}: columns are read as its header says: {columns.order}{rest}")
    if columns.metres_per_unit != 1.0:
        notes.append(
            f"{path.name}: positions are multiplied by {columns.metres_per_unit:g}, as its header says"
        )
    return notes


def _rotations(quats_xyzw: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quats_xyzw).as_matrix())
