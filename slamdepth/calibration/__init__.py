# SPDX-License-Identifier: Apache-2.0
"""Camera files: ``camera.yaml``, and the calibrations that other tools write.

Nothing here knows :class:`slamdepth.types.Camera`, which reads itself by :func:`read_camera`.
"""

from __future__ import annotations

from slamdepth.calibration.camera_yaml import (
    CAMERA_FILE,
    camera_yaml,
    make_camera,
    read_camera,
    read_values,
)
from slamdepth.calibration.plausible import Pinhole, check_plausible
from slamdepth.calibration.wide_lens import WIDE_MODELS, WideLens

__all__ = [
    "CAMERA_FILE",
    "WIDE_MODELS",
    "Pinhole",
    "WideLens",
    "camera_yaml",
    "check_plausible",
    "make_camera",
    "read_camera",
    "read_values",
]
