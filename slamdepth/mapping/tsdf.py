# SPDX-License-Identifier: Apache-2.0
"""Fusion of keyframes into a truncated signed distance field, and its surface.

Curless and Levoy, "A volumetric method for building complex models from range images"
(1996), on Open3D's sparse voxel blocks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from slamdepth.config import MapConfig
from slamdepth.geometry import invert
from slamdepth.mapping.dense_fusion import fuse_dense
from slamdepth.mapping.fusion_depth import View, consistent_pixels, trusted_depth
from slamdepth.mapping.keyframe import Keyframe
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.undistorted import undistorted_color, undistorted_depth
from slamdepth.open3d_loader import import_open3d

if TYPE_CHECKING:
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)

_BLOCK = 8  # voxels along the edge of a block; 10 KB each
_MAX_BLOCKS = 60_000
_ENLARGE = 1.4  # halves the blocks of a surface
_TRUNCATION_SENSOR = 4.0  # voxels
_TRUNCATION_PREDICTED = 8.0  # voxels; wide enough for predictions to average out


class _Fuse(Protocol):
    def __call__(
        self,
        keyframes: Sequence[Keyframe],
        settings: MapConfig,
        voxel_m: float,
        max_blocks: int,
        progress: Callable[[int, int], None] | None,
    ) -> Any: ...


def fuse_keyframes(
    keyframes: Sequence[Keyframe],
    settings: MapConfig,
    progress: Callable[[int, int], None] | None = None,
    *,
    max_blocks: int = _MAX_BLOCKS,
) -> Mesh:
    """Fuse the keyframes' depth and colour; returns the surface in the world frame.

    Where keyframes have dense depth, that is fused, each pixel by its deviation, see
    :class:`slamdepth.mapping.patches.Patches`. Else the depth they were given is; images and depth are
    undistorted here, and predicted depth has to pass two more tests than sensor depth: what other keyframes
    contradict is dropped, and a surface must be seen by two keyframes.

    Args:
        keyframes: optimised keyframes.
        settings: voxel size, depth limit, smallest connected component to keep.
        progress: called with (keyframes done, keyframes in all).
        max_blocks: memory limit, in blocks of 8^3 voxels (10 KB); a map that needs more gets
            larger voxels and a note.

    Returns:
        The mesh, empty and with a note where nothing could be fused. The same keyframes
        give the same mesh, vertex by vertex.
    """
    keyframes = [kf for kf in keyframes if np.isfinite(kf.T_world_camera).all()]
    if not keyframes:
        return Mesh.empty("no mesh: there are no keyframes")
    if any(keyframe.dense is not None for keyframe in keyframes):
        fuse: _Fuse = fuse_dense
    else:
        fuse = partial(_fuse_given, keep=_consistent(keyframes, settings))
    notes: list[str] = []
    voxel_m = settings.voxel_size_m
    while (raw := fuse(keyframes, settings, voxel_m, max_blocks, progress)) is None:
        voxel_m *= _ENLARGE
        notes = [
            f"mesh: voxels enlarged from {settings.voxel_size_m:g} to {voxel_m:.3g} m to stay within memory"
        ]
        logger.info(notes[0])
    if "indices" not in raw.triangle or len(raw.triangle.indices) == 0:
        return Mesh.empty(*notes, "no mesh: no keyframe has depth within the limits that makes a surface")
    vertices, triangles, colors = _without_small_components(
        raw.vertex.positions.numpy(),
        raw.triangle.indices.numpy(),
        raw.vertex.colors.numpy(),
        settings.min_component_triangles,
    )
    if len(triangles) == 0:
        return Mesh.empty(
            *notes,
            f"no mesh: no connected piece has {settings.min_component_triangles} triangles; "
            "lower map.min_component_triangles",
        )
    vertices, triangles, colors = ordered(vertices, triangles, colors)
    return Mesh(vertices, triangles, np.clip(colors, 0.0, 1.0), tuple(notes))


def _consistent(keyframes: Sequence[Keyframe], settings: MapConfig) -> list[NDArray[np.bool_] | None]:
    """Subsampled masks of the pixels to keep, for keyframes with predicted depth; None for sensor depth."""
    predicted = [k for k, keyframe in enumerate(keyframes) if not keyframe.prediction.is_sensor]
    views = [
        View.of(
            undistorted_depth(trusted_depth(keyframes[k], settings.max_depth_m), keyframes[k].frame.camera),
            keyframes[k].frame.camera,
            keyframes[k].T_world_camera,
        )
        for k in predicted
    ]
    keep: list[NDArray[np.bool_] | None] = [None] * len(keyframes)
    for k, mask in zip(predicted, consistent_pixels(views), strict=True):
        keep[k] = mask
    return keep


def _fuse_given(
    keyframes: Sequence[Keyframe],
    settings: MapConfig,
    voxel_m: float,
    max_blocks: int,
    progress: Callable[[int, int], None] | None,
    *,
    keep: Sequence[NDArray[np.bool_] | None],
) -> Any:
    """The surface of the depth that keyframes were given, as :func:`fuse_dense` returns it."""
    o3d = import_open3d()
    float32 = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (float32, float32, float32), ((1), (1), (3)),
        voxel_m, _BLOCK, min(10_000, max_blocks), o3d.core.Device("CPU:0"),
    )  # fmt: skip
    for k, keyframe in enumerate(keyframes):
        camera = keyframe.frame.camera
        depth = undistorted_depth(trusted_depth(keyframe, settings.max_depth_m), camera)
        mask = keep[k]
        if mask is not None:
            depth = np.where(_upsampled(mask, depth.shape), depth, np.float32(0.0))
        if depth.any():
            truncation = _TRUNCATION_SENSOR if keyframe.prediction.is_sensor else _TRUNCATION_PREDICTED
            color = undistorted_color(keyframe).astype(np.float32) / np.float32(255.0)
            depth_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth)))
            color_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(color)))
            K = o3d.core.Tensor(camera.K)
            T_camera_world = o3d.core.Tensor(np.ascontiguousarray(invert(keyframe.T_world_camera)))
            blocks = grid.compute_unique_block_coordinates(
                depth_image, K, T_camera_world, 1.0, settings.max_depth_m, truncation
            )
            if grid.hashmap().size() + len(blocks) > max_blocks:
                _, present = grid.hashmap().find(blocks)
                if grid.hashmap().size() + int((~present.numpy()).sum()) > max_blocks:
                    return None
            grid.integrate(
                blocks, depth_image, color_image, K, T_camera_world, 1.0, settings.max_depth_m, truncation
            )
        if progress is not None:
            progress(k + 1, len(keyframes))
    if grid.hashmap().size() == 0:
        return o3d.t.geometry.TriangleMesh()
    # few keyframes may have no second view
    is_predicted = not any(keyframe.prediction.is_sensor for keyframe in keyframes)
    least_views = 2 if is_predicted and len(keyframes) > 3 else 1
    return grid.extract_triangle_mesh(least_views - 0.5)


def _upsampled(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Upsample a mask to ``shape`` by nearest neighbour."""
    rows = np.minimum(np.arange(shape[0]) * mask.shape[0] // shape[0], mask.shape[0] - 1)
    columns = np.minimum(np.arange(shape[1]) * mask.shape[1] // shape[1], mask.shape[1] - 1)
    return np.asarray(mask[rows[:, None], columns], bool)


def _without_small_components(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    colors: NDArray[np.float32],
    min_triangles: int,
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
    """Drop connected components of fewer than ``min_triangles``, and the unused vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b, c = triangles.T
    start, end = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(len(vertices), len(vertices)))
    _, label = connected_components(graph, directed=False)
    size = np.bincount(label[a], minlength=int(label.max()) + 1)
    triangles = triangles[size[label[a]] >= min_triangles]
    used, renamed = np.unique(triangles, return_inverse=True)
    return vertices[used], renamed.reshape(-1, 3).astype(np.int32), colors[used]


def ordered(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], colors: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
    """Sort vertices and triangles: Open3D's order depends on its threads."""
    order = np.lexsort((*colors.T, *vertices.T))
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[triangles]
    # start each triangle at its lowest vertex; its orientation stays
    first = triangles.argmin(axis=1)
    triangles = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    return vertices[order], np.ascontiguousarray(triangles), colors[order]
