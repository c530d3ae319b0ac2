# SPDX-License-Identifier: Apache-2.0
"""Coloured points of a scene: what was measured densely, else its landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamdepth.errors import InputError
from slamdepth.export.scene import ExportScene
from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Bytes, Floats

MAX_START_POINTS = 200_000
"""More points than these are thinned: training makes splats where they are needed."""


def read_cloud(path: Path) -> tuple[Floats, Bytes]:
    """Points ``(N, 3)`` and colours ``(N, 3)`` uint8 of a PLY file.

    Raises:
        InputError: the file does not read as points.
    """
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points, np.float64)
    if len(points) == 0:
        raise InputError(f"{path}: holds no points, or is damaged")
    colors = np.asarray(cloud.colors, np.float64)
    if len(colors) != len(points):
        colors = np.full_like(points, 0.5)
    return points, np.rint(colors * 255.0).astype(np.uint8)


def start_points(scene: ExportScene, landmarks: tuple[Floats, Bytes]) -> tuple[Floats, Bytes]:
    """Points for splats to start from: the landmarks, and as much of the measured cloud as the limit allows.

    Args:
        landmarks: points ``(P, 3)`` and colours ``(P, 3)``; may be none.

    Returns:
        Points ``(N, 3)`` in the world frame and colours ``(N, 3)`` uint8.
    """
    points, colors = landmarks
    if scene.cloud is None:
        return points, colors
    more, their_colors = read_cloud(scene.cloud)
    room = max(MAX_START_POINTS - len(points), 0)
    if len(more) > room:
        kept = np.sort(np.random.default_rng(0).permutation(len(more))[:room])
        more, their_colors = more[kept], their_colors[kept]
    return np.concatenate([points, more]), np.concatenate([colors, their_colors])
