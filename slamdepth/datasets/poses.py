# SPDX-License-Identifier: Apache-2.0
"""Poses as data sets write them: matrices, checked and made trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.errors import DatasetError
from slamdepth.geometry import orthonormalised, quat_xyzw_to_rotation
from slamdepth.io import parse_float, read_lines
from slamdepth.types import Trajectory
from slamdepth.typing import Floats

_FARTHEST = 1e6
_ROTATION_TOLERANCE = 1e-2

OPENCV_OF_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera with x right, y up, z backward (OpenGL, ARKit, Blender) to x right, y down, z forward."""


def read_matrix(path: Path, columns: int, *, rows: int | None = None) -> Floats:
    """Numbers of a text file, ``(N, columns)``, separated by white space, commas or semicolons.

    Args:
        rows: how many there must be; None takes any number.

    Raises:
        DatasetError: the file cannot be read, a line does not have ``columns`` numbers, or the number of
            lines is another; names file and line.
    """
    table: list[list[float]] = []
    number = 1
    for number, line in read_lines(path):
        try:
            row = [parse_float(text) for text in line.replace(",", " ").replace(";", " ").split()]
        except ValueError:
            row = []
        if len(row) != columns or len(table) == rows:
            expected = f"{columns} numbers" if rows is None else f"{rows} lines of {columns} numbers"
            raise DatasetError(f"{path}:{number}: expected {expected}, found {line[:80]!r}")
        table.append(row)
    if rows is not None and len(table) != rows:
        raise DatasetError(
            f"{path}:{number}: expected {rows} lines of {columns} numbers, the file has {len(table)}"
        )
    return np.array(table, dtype=np.float64).reshape(-1, columns)


def checked_pose(T: Floats) -> Floats | None:
    """``T`` ``(4, 4)`` as an exact rigid transform; None where it is none (NaN, infinity, no rotation)."""
    if not np.isfinite(T).all() or np.abs(T).max() > _FARTHEST:
        return None
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-3):
        return None
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
        return None
    return orthonormalised(np.vstack([T[:3], [[0.0, 0.0, 0.0, 1.0]]]))


def read_pose(path: Path) -> Floats | None:
    """Read a ``(4, 4)`` camera-to-world pose; None where tracking was lost (NaN, infinity, zeros).

    Raises:
        DatasetError: the file does not hold four lines of four numbers; names file and line.
    """
    return checked_pose(read_matrix(path, 4, rows=4))


def trajectory_of(
    times_s: Floats,
    poses: list[Floats | None],
    notes: list[str],
    *,
    is_metric: bool = True,
    missing: str = "pose",
) -> Trajectory | None:
    """The trajectory of the poses that are there and valid; None where none is.

    Args:
        times_s: ``(N,)`` increasing.
        poses: ``N`` of ``(4, 4)``, None where there is none.
        notes: takes a line for those that are missing, and for those that are invalid.
        missing: what frames without a pose have not.
    """
    kept_s: list[float] = []
    kept: list[Floats] = []
    invalid = absent = 0
    for time_s, T in zip(times_s.tolist(), poses, strict=True):
        sound = None if T is None else checked_pose(T)
        if sound is not None:
            kept_s.append(time_s)
            kept.append(sound)
        elif T is None:
            absent += 1
        else:
            invalid += 1
    if invalid:
        notes.append(f"{invalid} invalid poses (NaN, infinity, no rotation) dropped from the ground truth")
    if absent and (kept or invalid):
        notes.append(f"{absent} of {len(poses)} frames have no {missing}")
    return Trajectory(np.array(kept_s), np.stack(kept), is_metric) if kept else None


def pose_of(position: Floats, quat_xyzw: Floats) -> Floats | None:
    """``(4, 4)`` of a position ``(3,)`` and a quaternion ``(4,)`` x y z w; None where it is no rotation."""
    if not (np.isfinite(position).all() and np.isfinite(quat_xyzw).all()):
        return None
    largest = float(np.abs(quat_xyzw).max())
    if not largest > 1e-9:
        return None
    T = np.eye(4)
    T[:3, :3] = quat_xyzw_to_rotation(quat_xyzw / largest)  # so that its norm cannot overflow
    T[:3, 3] = position
    return T
