# SPDX-License-Identifier: Apache-2.0
"""Trajectories as CSV in the columns of EuRoC's ground truth; times are whole nanoseconds."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

from slamdepth.export.registry import ExportFormat, ExportRequest, register_format
from slamdepth.geometry import rotation_to_quat_xyzw
from slamdepth.io import write_text

_HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"


@register_format
class EurocFormat(ExportFormat):
    """``data.csv``."""

    name = "euroc"
    about = "the trajectory as CSV with nanoseconds and w first, for evo, OpenVINS, maplab"

    def write(self, request: ExportRequest, folder: Path) -> tuple[str, ...]:
        trajectory = request.scene.trajectory
        rows = [_HEADER]
        for time_s, T in zip(trajectory.timestamps_s.tolist(), trajectory.T_world_camera, strict=True):
            x, y, z, w = rotation_to_quat_xyzw(T[:3, :3]).tolist()
            values = ",".join(f"{value:.10g}" for value in (*T[:3, 3].tolist(), w, x, y, z))
            rows.append(f"{nanoseconds(time_s)},{values}")
        write_text(folder / "data.csv", "\n".join(rows) + "\n")
        return (
            f"{len(trajectory)} poses of the camera (S) in the world (R); there is no body frame.",
            "Read it with: evo_traj euroc data.csv",
        )


def nanoseconds(time_s: float) -> int:
    """Whole nanoseconds of the decimal that a time was written as, not of its nearest binary number."""
    return int((Decimal(repr(time_s)) * 10**9).to_integral_value())
