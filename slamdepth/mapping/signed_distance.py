# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field in sparse blocks, to which each pixel adds with a weight of its own.

Curless and Levoy, "A volumetric method for building complex models from range images" (1996). Open3D gives
all pixels the same weight; here its grid holds the sums, and its marching cubes extract the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.geometry import invert
from slamdepth.mapping.patches import Patches
from slamdepth.open3d_loader import import_open3d
from slamdepth.typing import Floats, Floats32, Ints

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 8
"""Voxels along the edge of a block."""

_CELLS = BLOCK**3
_CHUNK = 512  # blocks at a time, some 30 MB
_NEAREST_M = 0.05
_TRUNCATION = 3.0  # voxels
_WITHIN_PIXEL = 0.1  # most relative change of depth within a pixel
_LEAST_COSINE = 0.02
_STRIDE_PX = 2
_AWAY = 1e-3  # weight of a colour far from its surface, in case there is no other


class SignedDistance:
    """Sums over views, in blocks of 8^3 voxels.

    A voxel's distance is the mean over views of how far it is in front of the plane of the pixel that it
    projects to, along z of the camera, at most three voxels, weighted by the pixel. A view says nothing of
    what lies farther behind its surface than that, and half as far behind it begins to count less, since what
    it sees may be thin. All space in front of a surface counts, so a floating piece that others see through
    is carved away.

    A slope of some five voxels of depth to one across, as depth is smeared to at an edge, leaves no surface:
    of two neighbouring voxels one is too far before it or behind it.

    Args:
        voxel_m: edge of a voxel.
        blocks: ``(B, 3)`` int32, each once; the lowest voxel of a block is at ``8 * block * voxel_m``.

    Raises:
        SlamdepthError: Open3D is not installed.
    """

    def __init__(self, voxel_m: float, blocks: NDArray[np.int32]) -> None:
        o3d = import_open3d()
        float32 = o3d.core.float32
        self._voxel_m, self._truncation_m = voxel_m, _TRUNCATION * voxel_m
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color", "color_weight"), (float32,) * 4, ((1), (1), (3), (1)),
            voxel_m, BLOCK, max(len(blocks), 1), o3d.core.Device("CPU:0"),
        )  # fmt: skip
        places, _ = self._grid.hashmap().activate(o3d.core.Tensor(np.ascontiguousarray(blocks)))
        self._places = places.numpy().astype(np.int64)
        self._origins_m = blocks.astype(np.float64) * (BLOCK * voxel_m)
        # views of the grid's own memory
        self._distance, self._weight, self._color, self._color_weight = (
            self._grid.attribute(name).numpy().reshape(-1, channels)
            for name, channels in (("tsdf", 1), ("weight", 1), ("color", 3), ("color_weight", 1))
        )
        for sums in (self._distance, self._weight, self._color, self._color_weight):
            sums[...] = 0.0
        z, y, x = np.mgrid[:BLOCK, :BLOCK, :BLOCK].reshape(3, -1)  # x runs fastest, as in Open3D
        self._cells_m = np.stack([x, y, z]) * voxel_m

    def add(self, view: Patches) -> None:
        """Add what a view says to all voxels that it sees."""
        T = invert(view.T_world_camera)
        origins = self._origins_m @ T[:3, :3].T + T[:3, 3]
        seen = self._in_sight(view, origins + T[:3, :3] @ self._cells_m.mean(axis=1))
        turned = (T[:3, :3] @ self._cells_m).astype(np.float32)
        for start in range(0, len(seen), _CHUNK):
            rows = seen[start : start + _CHUNK]
            first = origins[rows].astype(np.float32)
            cells = self._places[rows][:, None] * _CELLS + np.arange(_CELLS)
            self._add(view, cells.ravel(), [(first[:, i : i + 1] + turned[i]).ravel() for i in range(3)])

    def _in_sight(self, view: Patches, centres: Floats) -> Ints:
        """Rows of the blocks, given by their centres in the camera's frame, that the picture may hold."""
        camera, depth = view.camera, view.depth_m
        radius = 0.5 * np.sqrt(3.0) * BLOCK * self._voxel_m
        x, y, z = centres.T
        ahead = np.maximum(z + radius, 1e-6)  # the widest cone that still holds a part of the block
        reach = radius * np.hypot(1.0, np.hypot(camera.width / camera.fx, camera.height / camera.fy))
        farthest = (1.0 + _WITHIN_PIXEL) * float(depth.max()) + self._truncation_m + radius
        inside = (z > _NEAREST_M - radius) & (z < farthest)
        inside &= (x + reach) * camera.fx > -camera.cx * ahead
        inside &= (x - reach) * camera.fx < (camera.width - camera.cx) * ahead
        inside &= (y + reach) * camera.fy > -camera.cy * ahead
        inside &= (y - reach) * camera.fy < (camera.height - camera.cy) * ahead
        return np.flatnonzero(inside)

    def _add(self, view: Patches, cells: Ints, at: Sequence[Floats32]) -> None:
        """Add a view to voxels, given by their numbers ``(N,)`` and places ``(N,)`` in the camera's frame."""
        camera = view.camera
        fx, fy, cx, cy = (np.float32(one) for one in (camera.fx, camera.fy, camera.cx, camera.cy))
        x, y, z = at
        ahead = np.maximum(z, np.float32(_NEAREST_M))
        u, v = np.rint(x / ahead * fx + cx), np.rint(y / ahead * fy + cy)
        inside = (z > _NEAREST_M) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        kept = np.flatnonzero(inside)
        pixel = v[kept].astype(np.int64) * camera.width + u[kept].astype(np.int64)
        depth, truncation = view.depth_m.ravel()[pixel], np.float32(self._truncation_m)
        near = np.flatnonzero((depth > 0) & (z[kept] < np.float32(1.0 + _WITHIN_PIXEL) * depth + truncation))
        kept, pixel, depth = kept[near], pixel[near], depth[near]
        # where the voxel's ray meets the plane of the pixel
        normal = view.normal.reshape(-1, 3)[pixel].T
        row, column = np.divmod(pixel, camera.width)
        ray = x[kept] / z[kept], y[kept] / z[kept]
        of_pixel = (column.astype(np.float32) - cx) / fx, (row.astype(np.float32) - cy) / fy
        to_plane = depth * (normal[0] * of_pixel[0] + normal[1] * of_pixel[1] + normal[2])
        cosine = normal[0] * ray[0] + normal[1] * ray[1] + normal[2]
        distance = to_plane / np.maximum(cosine, np.float32(_LEAST_COSINE)) - z[kept]
        near = np.flatnonzero(distance > -truncation)
        cell, pixel, distance = cells[kept[near]], pixel[near], distance[near]
        weight = view.weight.ravel()[pixel]
        weight *= np.clip(np.float32(2.0) + np.float32(2.0) * distance / truncation, 0.0, 1.0)
        self._distance[cell, 0] += weight * np.minimum(distance, truncation)
        self._weight[cell, 0] += weight

        at_surface = np.flatnonzero(distance < truncation)
        cell, pixel, distance = cell[at_surface], pixel[at_surface], distance[at_surface]
        closeness = np.exp(np.float32(-0.5) * (distance / np.float32(self._voxel_m)) ** 2) + np.float32(_AWAY)
        weight = view.color_weight.ravel()[pixel] * closeness
        self._color[cell] += weight[:, None] * view.image_rgb.reshape(-1, 3)[pixel]
        self._color_weight[cell, 0] += weight

    def surface(self) -> Any:
        """The surface as Open3D's ``t.geometry.TriangleMesh``; the sums are used up."""
        if len(self._places) == 0:
            return import_open3d().t.geometry.TriangleMesh()
        np.divide(self._distance, self._weight * self._voxel_m, out=self._distance, where=self._weight > 0)
        np.divide(self._color, self._color_weight, out=self._color, where=self._color_weight > 0)  # to 255
        # only views with a surface nearby gave a colour; space that is just empty is no part of one
        self._weight[...] = (self._weight > 0) & (self._color_weight > 0)
        return self._grid.extract_triangle_mesh(0.5)


def blocks_of(view: Patches, voxel_m: float) -> NDArray[np.int32]:
    """The blocks ``(B, 3)``, sorted, within the truncation of the surface that a view sees."""
    camera, edge_m = view.camera, BLOCK * voxel_m
    row, column = np.nonzero(view.depth_m[::_STRIDE_PX, ::_STRIDE_PX] > 0)
    row, column = row * _STRIDE_PX, column * _STRIDE_PX
    z = view.depth_m[row, column].astype(np.float64)
    points = np.column_stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z])
    reach = points / z[:, None] * (_TRUNCATION * voxel_m)
    steps = 1 + int(np.ceil(4.0 * _TRUNCATION / BLOCK))  # of half a block
    R, t = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
    return union(
        [
            np.floor(((points + share * reach) @ R.T + t) / edge_m).astype(np.int32)
            for share in np.linspace(-1.0, 1.0, steps)
        ]
    )


def union(blocks: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
    """The blocks ``(B, 3)`` of several sets, each once, sorted."""
    every = np.concatenate([np.zeros((0, 3), np.int32), *blocks])
    every = every[np.lexsort(every.T[::-1])]
    first = np.ones(len(every), bool)
    first[1:] = (every[1:] != every[:-1]).any(axis=1)
    return np.asarray(every[first])
