# SPDX-License-Identifier: Apache-2.0
"""What a run results in: trajectory, keyframes, sparse map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from slamdepth.mapping.keyframe import Keyframe
from slamdepth.types import RunStatistics, Trajectory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from slamdepth.mapping.cloud import PointCloud
    from slamdepth.mapping.mesh import Mesh


@dataclass(frozen=True)
class Reconstruction:
    """The optimised result of a run, as ``Tracker.finish`` returns it.

    Attributes:
        trajectory: every placed frame, but for those that were withdrawn, see :class:`RunStatistics`.
        keyframes: those of the trajectory, in order of time; their ids may have gaps.
        points_m: ``(P, 3)`` float64 map points in the world frame, metres of the map.
        gravity_w: ``(3,)`` unit direction of gravity in the world frame, as most keyframes estimate it;
            None where they do not, or disagree.
        notes: what a reader of the result should know, one line each.
        statistics: counts and times of the run.
        others: maps of the same run that never met this one, the largest first. Each has its own world
            frame and its own scale, and its statistics count what is in it.
        loops: ids of the two keyframes of each loop in the pose graph, both among ``keyframes``.
    """

    trajectory: Trajectory
    keyframes: tuple[Keyframe, ...]
    points_m: NDArray[np.float64]
    gravity_w: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()
    statistics: RunStatistics = field(default_factory=RunStatistics)
    others: tuple[Reconstruction, ...] = ()
    loops: tuple[tuple[int, int], ...] = ()

    def fuse_mesh(
        self,
        voxel_size_m: float = 0.02,
        *,
        max_depth_m: float = 4.0,
        min_component_triangles: int = 200,
        progress: Callable[[int, int], None] | None = None,
    ) -> Mesh:
        """Fuse the depth and colour of all keyframes into a mesh (TSDF, Curless and Levoy 1996).

        Args:
            voxel_size_m: edge of a voxel in metres, at most 1; enlarged, with a note, where the map would
                not fit into memory.
            max_depth_m: depth beyond this is not fused.
            min_component_triangles: connected components with fewer triangles are removed.
            progress: called with (keyframes done, keyframes in all).

        Returns:
            The surface in the world frame; empty, with a note that says why, where nothing could be fused.

        Raises:
            ConfigError: a setting is out of range.
            SlamdepthError: Open3D is not installed.
        """
        from slamdepth.config import Config
        from slamdepth.mapping.tsdf import fuse_keyframes

        settings = {
            "voxel_size_m": voxel_size_m,
            "max_depth_m": max_depth_m,
            "min_component_triangles": min_component_triangles,
        }
        return fuse_keyframes(self.keyframes, Config.from_dict({"map": settings}, "mesh").map, progress)

    def measured_cloud(self, voxel_size_m: float = 0.01, *, max_depth_m: float = 4.0) -> PointCloud:
        """The points that several views or a sensor measured, one in each voxel.

        Args:
            voxel_size_m: edge of a voxel in metres; enlarged, with a note, beyond four million points.
            max_depth_m: depth beyond this is left out.

        Returns:
            Points in the world frame with normals and colours; none where a network alone gave depth.
        """
        from slamdepth.mapping.cloud import measured_cloud

        return measured_cloud(self.keyframes, voxel_size_m, max_depth_m)
