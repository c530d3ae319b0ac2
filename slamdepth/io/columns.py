# SPDX-License-Identifier: Apache-2.0
"""Headers of trajectory files: which column is what, and in which unit.

TUM: ``# timestamp tx ty tz qx qy qz qw``. EuRoC and TUM-VI: ``#timestamp [ns],p_RS_R_x [m],...,q_RS_w [],
q_RS_x [],...``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slamdepth.errors import DatasetError
from slamdepth.io.times import TimeUnit

_TIME_UNITS = {
    TimeUnit.SECONDS: ("s", "sec", "secs", "second", "seconds"),
    TimeUnit.MILLISECONDS: ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    TimeUnit.MICROSECONDS: ("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"),
    TimeUnit.NANOSECONDS: ("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"),
}
_METRES = {"": 1.0, "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0}
_METRES |= {"cm": 1e-2, "mm": 1e-3, "millimetres": 1e-3, "millimeters": 1e-3}
_TIME_NAMES = ("t", "ts", "sec", "secs", "seconds", "nsec", "ns", "us", "ms")
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_NAME = re.compile(r"[^\s,;\[\]()]+\s*(?:[\[(][^\])]*[\])])?")
_AXIS = re.compile(r"(.*?)[_.\-]?([xyzw])")


@dataclass(frozen=True)
class Columns:
    """Where the numbers of a pose are in a line.

    Attributes:
        count: columns in a line.
        time: index of the time.
        position: indices of x, y, z.
        quat_xyzw: indices of the quaternion's x, y, z, w.
        time_unit: the unit that the header names, or None.
        metres_per_unit: of the positions.
    """

    count: int = 8
    time: int = 0
    position: tuple[int, ...] = (1, 2, 3)
    quat_xyzw: tuple[int, ...] = (4, 5, 6, 7)
    time_unit: TimeUnit | None = None
    metres_per_unit: float = 1.0

    @property
    def indices(self) -> tuple[int, ...]:
        """Indices of time, position and quaternion x y z w."""
        return (self.time, *self.position, *self.quat_xyzw)

    @property
    def order(self) -> str:
        """Time, axes and quaternion parts in the order of the file."""
        named = dict(zip(self.indices, ("time", "x", "y", "z", "qx", "qy", "qz", "qw"), strict=True))
        return " ".join(named[index] for index in sorted(named))


TUM_COLUMNS = Columns()


def stated_unit(comments: Sequence[str]) -> TimeUnit | None:
    """The unit of time that a header such as ``# timestamp [ns] filename`` names; None where none does."""
    for comment in reversed(comments):
        names = column_names(comment)
        if names and _role(names[0][0]) == "time":
            return time_unit_of(*names[0])
    return None


def find_columns(path: Path, headers: Sequence[str], count: int) -> Columns | None:
    """The columns by the last of the lines ``headers`` that names ``count``; None where none does.

    Raises:
        DatasetError: the header describes poses, but without a quaternion or in an unknown unit.
    """
    for header in reversed(headers):
        names = column_names(header)
        roles = [_role(name) for name, _ in names]
        if len(names) != count or "time" not in roles or "px" not in roles:
            continue
        missing = [role for role in ("py", "pz", "qx", "qy", "qz", "qw") if role not in roles]
        if missing:
            raise DatasetError(
                f"{path}: its header {header.strip()[:120]!r} names no quaternion and position with x, y, z "
                "and w; needed are columns such as 'timestamp tx ty tz qx qy qz qw'"
            )
        at = {role: roles.index(role) for role in roles if role}
        unit = names[at["px"]][1].lower()
        if unit not in _METRES:
            raise DatasetError(f"{path}: its header gives positions in {unit!r}, not in m, cm or mm")
        return Columns(
            count,
            at["time"],
            tuple(at[f"p{axis}"] for axis in "xyz"),
            tuple(at[f"q{axis}"] for axis in "xyzw"),
            time_unit_of(*names[at["time"]]),
            _METRES[unit],
        )
    return None


def column_names(header: str) -> list[tuple[str, str]]:
    """Names and units of the columns; the unit is what stands in brackets behind a name."""
    text = header.strip().lstrip("#%/ ").strip()
    without_units = _BRACKETS.sub("", text)
    separator = next((mark for mark in ",;\t" if mark in without_units), None)
    if separator is None:
        pieces = _NAME.findall(text)
    else:  # a separator within brackets does not separate
        kept = _BRACKETS.sub(lambda found: found[0].replace(separator, " "), text)
        pieces = [piece for piece in kept.split(separator) if piece.strip()]
    named = []
    for piece in pieces:
        unit = _BRACKETS.search(piece)
        name = _BRACKETS.sub("", piece).strip().strip("\"'").lower()
        named.append((re.sub(r"\s+", "_", name), unit[1].strip() if unit else ""))
    return named


def _role(name: str) -> str | None:
    """``time``, ``px`` to ``pz``, ``qx`` to ``qw``, or None for any other column."""
    if name in _TIME_NAMES or "time" in name or "stamp" in name:
        return "time"
    found = _AXIS.fullmatch(name)
    if found is None:
        return None
    before, axis = found.groups()
    if before.startswith("q") or any(word in before for word in ("quat", "orient", "rot")):
        return f"q{axis}"
    is_position = before in ("", "t", "p") or before.startswith(("p_", "t_"))
    if axis != "w" and (is_position or any(word in before for word in ("pos", "trans"))):
        return f"p{axis}"
    return None


def time_unit_of(name: str, bracket: str) -> TimeUnit | None:
    stated = bracket.lower() or re.split(r"[_.\-]", name)[-1]
    return next((unit for unit, words in _TIME_UNITS.items() if stated in words), None)
