# SPDX-License-Identifier: Apache-2.0
"""Sequences: :func:`open_dataset` reads any known layout; ``camera.yaml`` holds intrinsics."""

from __future__ import annotations

from slamdepth.datasets.association import associate
from slamdepth.datasets.base import Dataset
from slamdepth.datasets.camera_file import CAMERA_FILE, read_camera, write_camera
from slamdepth.datasets.registry import Reader, known_readers, open_dataset, register_reader

__all__ = [
    "CAMERA_FILE",
    "Dataset",
    "Reader",
    "associate",
    "known_readers",
    "open_dataset",
    "read_camera",
    "register_reader",
    "write_camera",
]
