# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the format of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path

from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.io import write_tum_trajectory


@register_format
class TumFormat(ExportFormat):
    """``trajectory.txt``."""

    name = "tum"
    about = "the trajectory as 'timestamp tx ty tz qx qy qz qw', for evo and TUM's tools"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        write_tum_trajectory(folder / "trajectory.txt", request.scene.trajectory)
        return (
            f"{len(request.scene.trajectory)} poses, camera to world; seconds, metres.",
            "Read it with: evo_traj tum trajectory.txt",
        )
