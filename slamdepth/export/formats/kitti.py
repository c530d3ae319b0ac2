# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the format of the KITTI odometry benchmark."""

from __future__ import annotations

from pathlib import Path

from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.io import format_timestamp, write_text


@register_format
class KittiFormat(ExportFormat):
    """``poses.txt`` and ``times.txt``."""

    name = "kitti"
    about = "the trajectory as twelve numbers a line, for evo and KITTI's tools"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        trajectory = request.scene.trajectory
        rows = [
            " ".join(f"{value:.10g}" for value in T[:3].ravel().tolist()) for T in trajectory.T_world_camera
        ]
        times = [format_timestamp(time_s) for time_s in trajectory.timestamps_s.tolist()]
        write_text(folder / "poses.txt", "".join(f"{row}\n" for row in rows))
        write_text(folder / "times.txt", "".join(f"{time}\n" for time in times))
        return (
            f"poses.txt: {len(trajectory)} poses, the first three rows of T_world_camera, row by row.",
            "times.txt: the time of each pose in seconds. KITTI's tools expect one for every frame; a frame "
            "without a pose has no line here.",
            "Read it with: evo_traj kitti poses.txt",
        )
