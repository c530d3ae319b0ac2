# SPDX-License-Identifier: Apache-2.0
"""Finished maps as files that other tools read."""

from __future__ import annotations

from slamdepth.export.images import ImageMode
from slamdepth.export.registry import FORMATS, ExportRequest, export_format, register_format
from slamdepth.export.scene import ExportScene, View
from slamdepth.export.write import is_export, write_export

__all__ = [
    "FORMATS",
    "ExportRequest",
    "ExportScene",
    "ImageMode",
    "View",
    "export_format",
    "is_export",
    "register_format",
    "write_export",
]
