# SPDX-License-Identifier: Apache-2.0
"""What a run ends with: ``report.json``, ``report.html`` and tables for the terminal."""

from __future__ import annotations

from slamdepth.report.camera import CameraFacts
from slamdepth.report.console import run_table, scale_table, surface_table, trajectory_table
from slamdepth.report.data import MapData, MeshCounts, ReportData
from slamdepth.report.html import build_html
from slamdepth.report.mesh_images import MeshImage, render_errors, render_mesh_images, write_mesh_png
from slamdepth.report.scale import ScaleFacts, ScalePart, ScaleSource
from slamdepth.report.summary import build_summary
from slamdepth.report.write import write_report

__all__ = [
    "CameraFacts",
    "MapData",
    "MeshCounts",
    "MeshImage",
    "ReportData",
    "ScaleFacts",
    "ScalePart",
    "ScaleSource",
    "build_html",
    "build_summary",
    "render_errors",
    "render_mesh_images",
    "run_table",
    "scale_table",
    "surface_table",
    "trajectory_table",
    "write_mesh_png",
    "write_report",
]
