# SPDX-License-Identifier: Apache-2.0
"""Files of inertial data: EuRoC's, and CSV files of phone apps whose first line names the columns.

Without a header a line is ``time wx wy wz ax ay az`` in rad/s and m/s^2, as in EuRoC's ``imu0/data.csv``.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.io.columns import column_names, stated_unit, time_unit_of
from slamdepth.io.text import parse_float, read_commented_lines
from slamdepth.io.times import TimeColumn, TimeUnit, conversion_notes, judge_unit

if TYPE_CHECKING:
    from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665
"""m/s^2; what accelerometers call 1 g."""

_FEWEST = 20
_LARGEST = 1e20
"""Nanoseconds since 1970 are smaller; NaN is not."""
_AXES = re.compile(r"(.*?)[_.\-]?([xyz])(?:_?(?:axis|rad.*|deg.*|m.?s.*|g))?")
_GYRO = ("gyr", "rotationrate", "rotation_rate", "omega", "angular", "angvel", "ang_vel")
_ACC = ("acc",)
_NOT_RAW = ("user", "linear", "lin_acc", "gravity", "filtered", "bias", "uncal")
"""Parts of names of columns that are no raw rates and specific forces."""
_WIDTH = 7
_ORDER = (1, 2, 3), (4, 5, 6)


@dataclass(frozen=True)
class ImuData:
    """Inertial data in the sensor's own frame.

    Attributes:
        times_s: ``(N,)`` strictly increasing.
        rates: ``(N, 3)`` angular velocity in rad/s.
        forces: ``(N, 3)`` specific force in m/s^2; upwards, of 1 g, where it rests.
    """

    times_s: NDArray[np.float64]
    rates: NDArray[np.float64]
    forces: NDArray[np.float64]


@dataclass(frozen=True)
class _ImuColumns:
    """Where time, angular velocity and specific force are, and the factors to rad/s and m/s^2."""

    rates: tuple[int, ...] = _ORDER[0]
    forces: tuple[int, ...] = _ORDER[1]
    time: int = 0
    to_rad: float = 1.0
    to_m_s2: float = 1.0
    time_unit: TimeUnit | None = None
    count: int = _WIDTH


def read_imu(path: str | Path) -> tuple[ImuData, list[str]]:
    """Read a file of inertial data.

    Units are those that the header names: rad/s or deg/s, m/s^2 or g. Rows that are not finite, or do not
    come after the one before, are dropped.

    Returns:
        The data, and one line for each conversion and repair.

    Raises:
        DatasetError: the file is missing, names no angular velocities and accelerations, or a line is
            malformed (the line is named).
    """
    path = Path(path)
    lines = read_commented_lines(path)
    comments = [line for _, line in lines if line.startswith("#")]
    data = [(number, line) for number, line in lines if not line.startswith("#")]
    columns = None
    if data and not _is_number(_fields(data[0][1])[0]):
        columns = _find(path, data[0][1], required=True)
        data = data[1:]
    elif comments:
        columns = _find(path, comments[-1], required=False)
    columns = columns or _ImuColumns(time_unit=stated_unit(comments))
    texts, rows, dropped = _rows(path, data, columns)
    if len(rows) < _FEWEST:
        raise DatasetError(f"{path}: holds {len(rows)} rows of inertial data, at least {_FEWEST} are needed")
    table = np.array(rows)
    times = TimeColumn(tuple(texts), columns.time_unit)
    verdict = judge_unit(times, of_images=False)
    if verdict.unit is None:
        raise DatasetError(f"{path}: times such as {texts[0]} fit no unit: write them in seconds")
    notes = conversion_notes(path.name, times, verdict)
    if dropped:
        notes.append(f"{path.name}: {dropped} rows dropped that are not finite or do not follow in time")
    if columns.to_rad != 1.0:
        notes.append(f"{path.name}: angular velocities are in degrees, as its header says")
    if columns.to_m_s2 != 1.0:
        notes.append(f"{path.name}: accelerations are in g, as its header says")
    rates, forces = table[:, 1:4] * columns.to_rad, table[:, 4:7] * columns.to_m_s2
    return ImuData(times.seconds(verdict.unit), rates, forces), notes


def _find(path: Path, header: str, *, required: bool) -> _ImuColumns | None:
    """The columns that a header names."""
    names = column_names(header)
    at: dict[tuple[str, str], int] = {}
    time: int | None = None
    for index, (name, _) in enumerate(names):
        role = _role(name)
        if role == "time":
            time = index if time is None else time
        elif role is not None:
            at.setdefault((role[0], role[1]), index)
    rates = tuple(at[("w", axis)] for axis in "xyz" if ("w", axis) in at)
    forces = tuple(at[("a", axis)] for axis in "xyz" if ("a", axis) in at)
    if time is None or len(rates) < 3 or len(forces) < 3:
        if not required:
            return None
        raise DatasetError(
            f"{path}: its header {header[:100]!r} does not name a time, angular velocities (gyro_x ...) and "
            "accelerations (acc_x ...); one file with both is needed"
        )
    return _ImuColumns(
        rates,
        forces,
        time,
        math.pi / 180.0 if "deg" in "".join(names[rates[0]]).lower() else 1.0,
        STANDARD_GRAVITY if names[forces[0]][1].strip().lower() in ("g", "gs") else 1.0,
        time_unit_of(*names[time]),
        len(names),
    )


def _role(name: str) -> str | None:
    """``time``, ``wx`` to ``wz``, ``ax`` to ``az``, or None for any other column."""
    if "time" in name or "stamp" in name or name in ("t", "ts", "sec", "seconds"):
        return "time"
    found = _AXES.fullmatch(name)
    if found is None or any(word in name for word in _NOT_RAW):
        return None
    before, axis = found.groups()
    if before in ("w", "g", "omega") or before.startswith("w_") or any(word in before for word in _GYRO):
        return f"w{axis}"
    if before == "a" or before.startswith("a_") or any(word in before for word in _ACC):
        return f"a{axis}"
    return None


def _rows(
    path: Path, data: list[tuple[int, str]], columns: _ImuColumns
) -> tuple[list[str], list[list[float]], int]:
    """Times as they are written, and rows of time, rates and forces in increasing time."""
    texts: list[str] = []
    rows: list[list[float]] = []
    wanted = (columns.time, *columns.rates, *columns.forces)
    for number, line in data:
        fields = _fields(line)
        try:
            if len(fields) < columns.count:
                raise ValueError
            row = [parse_float(fields[index]) for index in wanted]
        except ValueError as error:
            raise DatasetError(
                f"{path}:{number}: expected {columns.count} columns of numbers with time, angular velocities "
                f"and accelerations, found {line[:80]!r}"
            ) from error
        if all(abs(value) < _LARGEST for value in row) and (not rows or row[0] > rows[-1][0]):
            texts.append(fields[columns.time])
            rows.append(row)
    return texts, rows, len(data) - len(rows)


def _fields(line: str) -> list[str]:
    separator = next((mark for mark in ",;\t" if mark in line), None)
    fields = line.split(separator) if separator else line.split()
    return [field.strip().strip('"') for field in fields]


def _is_number(text: str) -> bool:
    try:
        parse_float(text)
    except ValueError:
        return False
    return True
