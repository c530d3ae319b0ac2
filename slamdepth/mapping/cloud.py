# SPDX-License-Identifier: Apache-2.0
"""The points that keyframes measured, thinned to one in each voxel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import transform
from slamdepth.io import encode_ply, replacing
from slamdepth.mapping.dense_depth import DenseDepth
from slamdepth.mapping.fusion_depth import trusted_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.patches import Patches
from slamdepth.mapping.undistorted import undistorted_color, undistorted_depth
from slamdepth.typing import Bytes, Floats, Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_POINTS = 4_000_000  # 450 MB while they are put together
_ENLARGE = 2.0**0.5  # halves the voxels of a surface
_BATCH = 16  # keyframes between two mergers
_SENSOR_SIGMA = 0.01


@dataclass(frozen=True)
class PointCloud:
    """Points in the world frame.

    Attributes:
        points_m: ``(N, 3)`` float32 metres of the map.
        normals: ``(N, 3)`` float32 unit normals, towards the cameras.
        colors: ``(N, 3)`` uint8 sRGB.
        notes: what was limited when it was made, one line each.
    """

    points_m: Floats32
    normals: Floats32
    colors: Bytes
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points_m)

    def save(self, path: str | Path) -> None:
        """Write the points as binary PLY, whole or not at all.

        Raises:
            OutputError: ``path`` cannot be written.
        """
        data = encode_ply(self.points_m, self.colors, normals=self.normals)
        with replacing(path) as temporary:
            temporary.write_bytes(data)


def measured_cloud(
    keyframes: Sequence[Keyframe], voxel_m: float, max_depth_m: float, *, max_points: int = _MAX_POINTS
) -> PointCloud:
    """The points that several views or a sensor measured; nothing that a network predicted.

    The points of a voxel are averaged: places and normals by the deviation of their depth, colours with more
    weight on sharp, frontal and close views.

    Args:
        voxel_m: edge of a voxel.
        max_depth_m: depth beyond this is left out.
        max_points: memory limit; what needs more gets larger voxels and a note.

    Returns:
        The points, sorted by voxel; none where nothing was measured.
    """
    sums, asked = _Sums.none(), voxel_m
    waiting: list[_Sums] = []
    for k, keyframe in enumerate(keyframes):
        dense = _measured(keyframe, max_depth_m)
        if dense is not None and np.isfinite(keyframe.T_world_camera).all():
            view = Patches.of(dense, keyframe.T_world_camera, voxel_m, max_depth_m)
            waiting.append(_Sums.of(view, dense.is_measured).by_voxel(voxel_m))
        if len(waiting) == _BATCH or k == len(keyframes) - 1:
            sums = _Sums.joined([sums, *waiting]).by_voxel(voxel_m)
            waiting = []
            while len(sums.rows) > max_points:
                voxel_m *= _ENLARGE
                sums = sums.by_voxel(voxel_m)
    rows = sums.rows
    normals = rows[:, 4:7] / np.maximum(np.linalg.norm(rows[:, 4:7], axis=1, keepdims=True), 1e-12)
    colors = np.round(rows[:, 8:] / np.maximum(rows[:, 7:8], 1e-12))
    notes = [] if voxel_m == asked else [
        f"cloud: voxels enlarged from {asked:g} to {voxel_m:.3g} m to stay within {max_points} points"
    ]  # fmt: skip
    return PointCloud(
        sums.points.astype(np.float32),
        normals.astype(np.float32),
        np.clip(colors, 0, 255).astype(np.uint8),
        tuple(notes),
    )


@dataclass(frozen=True)
class _Sums:
    """Weighted sums of points; columns: weight, place (3), normal (3), weight of the colour, colour (3)."""

    rows: Floats

    @classmethod
    def none(cls) -> _Sums:
        return cls(np.zeros((0, 11)))

    @classmethod
    def joined(cls, parts: Sequence[_Sums]) -> _Sums:
        return cls(np.concatenate([part.rows for part in parts]))

    @classmethod
    def of(cls, view: Patches, chosen: NDArray[np.bool_]) -> _Sums:
        """One row for each chosen pixel of a view that has depth."""
        camera, T = view.camera, view.T_world_camera
        row, column = np.nonzero((view.depth_m > 0) & chosen)
        z = view.depth_m[row, column].astype(np.float64)
        places = np.column_stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z])
        weight = view.weight[row, column].astype(np.float64)[:, None]
        normals = -view.normal[row, column] @ T[:3, :3].T
        of_color = view.color_weight[row, column].astype(np.float64)[:, None]
        colors = view.image_rgb[row, column] * of_color
        return cls(np.hstack([weight, weight * transform(T, places), weight * normals, of_color, colors]))

    @property
    def points(self) -> Floats:
        return self.rows[:, 1:4] / self.rows[:, :1]

    def by_voxel(self, voxel_m: float) -> _Sums:
        """One row for each voxel, sorted."""
        voxel = np.floor(self.points / voxel_m).astype(np.int64)
        order = np.lexsort(voxel.T[::-1])
        voxel = voxel[order]
        first = np.ones(len(voxel), bool)
        first[1:] = (voxel[1:] != voxel[:-1]).any(axis=1)
        starts: Ints = np.flatnonzero(first)
        if len(starts) == 0:
            return self
        return _Sums(np.add.reduceat(self.rows[order], starts, axis=0))


def _measured(keyframe: Keyframe, max_depth_m: float) -> DenseDepth | None:
    """Dense depth of a keyframe, or its sensor's; None where a network alone gave it depth."""
    if keyframe.dense is not None:
        return keyframe.dense.load()
    if not keyframe.prediction.is_sensor:
        return None
    camera = keyframe.frame.camera
    depth = undistorted_depth(trusted_depth(keyframe, max_depth_m), camera)
    return DenseDepth(
        camera.without_distortion(),
        undistorted_color(keyframe),
        depth,
        np.full(depth.shape, _SENSOR_SIGMA, np.float32),
        depth > 0,
    )
