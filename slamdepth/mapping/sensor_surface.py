# SPDX-License-Identifier: Apache-2.0
"""The surface that a depth sensor saw from known poses: a reference to score meshes against."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import backproject, invert
from slamdepth.mapping.fusion_depth import View, at_jumps
from slamdepth.mapping.tsdf import ordered
from slamdepth.mapping.undistorted import undistorted_depth
from slamdepth.open3d_loader import import_open3d
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCK, _BLOCKS = 8, 20_000
_TRUNCATION = 4.0  # voxels
_FEW = 10  # frames
_LEAST_VIEWS = 3


@dataclass(frozen=True)
class SensorFrame:
    """One depth image of a sensor.

    Attributes:
        depth_m: ``(H, W)`` metres along z in the raw pixels of ``camera``, 0 where unknown.
        T_world_camera: ``(4, 4)`` its true pose.
    """

    depth_m: Floats32
    camera: Camera
    T_world_camera: Floats


@dataclass(frozen=True)
class SensorSurface:
    """What a depth sensor saw.

    Attributes:
        vertices_m, triangles: ``(V, 3)`` and ``(T, 3)``, in the world of the poses.
        views: the depth it was made of, subsampled; 0 also where the surface does not confirm it.
        behind_m: how far behind what was seen a point can still be judged.
    """

    vertices_m: Floats32
    triangles: NDArray[np.int32]
    views: Sequence[View]
    behind_m: float

    @property
    def cameras(self) -> Floats:
        """Poses ``(N, 4, 4)`` of the views."""
        return np.array([view.T_world_camera for view in self.views]).reshape(-1, 4, 4)

    def can_judge(self, points: Floats) -> Bools:
        """Mask ``(N,)`` of the world points ``(N, 3)`` about which the sensor knew something.

        A point is judged if, in at least one view, it lies in front of the camera, in a pixel whose depth
        is known, within range and on the fused surface, and not farther than ``behind_m`` behind that
        depth. So a floating piece in space that was seen to be empty is judged; what lies outside of every
        view, behind or in front of an unknown pixel, or hidden behind a seen surface is not. The usual
        culling by frustum and occlusion (Azinovic et al., "Neural RGB-D surface reconstruction", 2022; Zhu
        et al., "NICE-SLAM", 2022) does the same with a tolerance of centimetres, which excuses walls that
        are too far away.
        """
        judged = np.zeros(len(points), bool)
        for view in self.views:
            open_ = np.flatnonzero(~judged)
            z, found, known = view.seen(points[open_])
            judged[open_] = known & (z <= found + self.behind_m)
        return judged


def fuse_sensor(
    frames: Iterable[SensorFrame],
    voxel_m: float,
    max_depth_m: float,
    behind_m: float,
    *,
    least_views: int | None = None,
) -> SensorSurface:
    """Fuse sensor depth at known poses into a surface (TSDF, Curless and Levoy 1996).

    Pixels beyond ``max_depth_m`` or at a depth jump count as unknown.

    Args:
        voxel_m: edge of a voxel.
        behind_m: see :class:`SensorSurface`.
        least_views: views that must have seen a surface; None: three of ten views or more, else one.

    Returns:
        The surface; without triangles where nothing was seen.

    Raises:
        SlamdepthError: Open3D is not installed.
    """
    o3d = import_open3d()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1), (1)), voxel_m, _BLOCK, _BLOCKS,
        o3d.core.Device("CPU:0"),
    )  # fmt: skip
    views: list[View] = []
    for frame in frames:
        unknown = (frame.depth_m > max_depth_m) | at_jumps(frame.depth_m)
        depth = undistorted_depth(np.where(unknown, np.float32(0.0), frame.depth_m), frame.camera)
        views.append(View.of(depth, frame.camera, frame.T_world_camera))
        if not depth.any():
            continue
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth, np.float32)))
        K = o3d.core.Tensor(frame.camera.K)
        T_camera_world = o3d.core.Tensor(np.ascontiguousarray(invert(frame.T_world_camera)))
        blocks = grid.compute_unique_block_coordinates(
            image, K, T_camera_world, 1.0, max_depth_m, _TRUNCATION
        )
        grid.integrate(blocks, image, K, T_camera_world, 1.0, max_depth_m, _TRUNCATION)
    nothing = SensorSurface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), views, behind_m)
    if grid.hashmap().size() == 0:
        return nothing
    if least_views is None:
        least_views = _LEAST_VIEWS if len(views) >= _FEW else 1
    mesh = grid.extract_triangle_mesh(least_views - 0.5)
    if "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
        return nothing
    positions = mesh.vertex.positions.numpy()
    vertices, triangles, _ = ordered(positions, mesh.triangle.indices.numpy(), np.zeros_like(positions))
    confirmed = _confirmed(views, vertices, triangles, _TRUNCATION * voxel_m)
    return SensorSurface(vertices, triangles, confirmed, behind_m)


def _confirmed(
    views: Sequence[View], vertices_m: Floats32, triangles: NDArray[np.int32], within_m: float
) -> list[View]:
    """The views without depth that is farther than ``within_m`` from the surface, along the pixel's ray."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices_m), o3d.core.Tensor(triangles.astype(np.uint32)))
    found: list[View] = []
    for view in views:
        known = np.flatnonzero(view.depth_m > 0)
        v, u = np.divmod(known, view.camera.width)
        px = np.stack([u, v], axis=1).astype(np.float64)
        directions = backproject(view.camera, px, np.ones(len(px))) @ view.T_world_camera[:3, :3].T
        origins = np.broadcast_to(view.T_world_camera[:3, 3], directions.shape)
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        hit_m = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()  # of rays of unit z: depth
        depth = view.depth_m.ravel().copy()
        depth[known[~(np.abs(hit_m - depth[known]) <= within_m)]] = 0.0
        found.append(replace(view, depth_m=depth.reshape(view.depth_m.shape)))
    return found
