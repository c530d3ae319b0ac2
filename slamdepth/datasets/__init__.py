# SPDX-License-Identifier: Apache-2.0
"""Sequences of images: :func:`open_dataset` reads any known layout."""

from __future__ import annotations

from slamdepth.datasets.association import associate
from slamdepth.datasets.base import Dataset
from slamdepth.datasets.options import ReadOptions
from slamdepth.datasets.registry import Reader, known_readers, open_dataset, register_reader
from slamdepth.io import write_camera

__all__ = [
    "Dataset",
    "ReadOptions",
    "Reader",
    "associate",
    "known_readers",
    "open_dataset",
    "register_reader",
    "write_camera",
]
