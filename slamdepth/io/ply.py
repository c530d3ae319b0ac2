# SPDX-License-Identifier: Apache-2.0
"""Binary PLY: coloured points, with or without triangles between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.io.text import replacing

if TYPE_CHECKING:
    from numpy.typing import NDArray


def encode_ply(
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    triangles: NDArray[np.integer] | None = None,
    comments: Sequence[str] = (),
    *,
    normals: NDArray[np.floating] | None = None,
) -> bytes:
    """A little-endian binary PLY file.

    Args:
        points: ``(N, 3)``, stored as float32.
        colors: ``(N, 3)`` uint8 RGB.
        triangles: ``(T, 3)`` numbers of points; None for a file of points alone.
        comments: lines of text for its header; what is not ASCII is escaped.
        normals: ``(N, 3)``, stored as float32; None for a file without.

    Raises:
        ValueError: the shapes do not fit together, or a comment has a line break.
    """
    if points.shape != (len(points), 3) or colors.shape != points.shape:
        raise ValueError(f"points and colours must both be (N, 3), got {points.shape} and {colors.shape}")
    if normals is not None and normals.shape != points.shape:
        raise ValueError(f"normals must be {points.shape} as the points are, got {normals.shape}")
    if any("\n" in line or "\r" in line for line in comments):
        raise ValueError("a comment of a PLY file is one line")
    parts = [("position", "<f4", 3), *([] if normals is None else [("normal", "<f4", 3)]), ("color", "u1", 3)]
    vertices = np.empty(len(points), parts)
    vertices["position"], vertices["color"] = points, colors
    if normals is not None:
        vertices["normal"] = normals
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property float n{axis}" for axis in "xyz" if normals is not None),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
    ]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    header.append("end_header")
    return ("\n".join(header) + "\n").encode("ascii", errors="backslashreplace") + body


def write_point_cloud(
    path: str | Path,
    points_m: NDArray[np.floating],
    colors: NDArray[np.uint8],
    comments: Sequence[str] = (),
) -> None:
    """Write points ``(N, 3)`` in metres with their ``(N, 3)`` uint8 RGB colours, whole or not at all.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    data = encode_ply(points_m, colors, comments=comments)
    with replacing(path) as temporary:
        temporary.write_bytes(data)
