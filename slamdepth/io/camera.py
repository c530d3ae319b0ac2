# SPDX-License-Identifier: Apache-2.0
"""Writing of camera files; :meth:`slamdepth.types.Camera.from_file` reads them."""

from __future__ import annotations

from pathlib import Path

from slamdepth.calibration import camera_yaml
from slamdepth.io.text import write_text
from slamdepth.types import Camera


def write_camera(path: str | Path, camera: Camera) -> None:
    """Write a ``camera.yaml`` that :meth:`~slamdepth.types.Camera.from_file` reads back, should the
    camera be a plausible one.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    write_text(path, camera_yaml(camera))
