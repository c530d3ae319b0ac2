# SPDX-License-Identifier: Apache-2.0
"""Images that repeat the one before, as webcams and converters of videos give where one comes too late."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slamdepth.types import Frame

# In grey levels. A video's encoder changes a repeated image by 0.14 on average and 3 in a cell; images of a
# moving camera differ by 1.8 and 23 or more, also in a rendered room of bare walls without noise.
_MAX_MEAN = 0.2
_MAX_CELL = 3.0
_CELL_PX = 16
_SAMPLED_ROWS = 16  # every so many, looked at first


def is_repeated(image_rgb: NDArray[np.uint8], before_rgb: NDArray[np.uint8]) -> bool:
    """Whether an image ``(h, w, 3)`` shows what the one before shows, to the errors of a video's encoder.

    A sensor's noise alone makes two images of a standing camera differ by more.
    """
    import cv2

    rows = slice(_SAMPLED_ROWS // 2, None, _SAMPLED_ROWS)
    if cv2.norm(image_rgb[rows], before_rgb[rows], cv2.NORM_L1) > 2.0 * _MAX_MEAN * image_rgb[rows].size:
        return False
    difference = cv2.absdiff(cv2.extractChannel(image_rgb, 1), cv2.extractChannel(before_rgb, 1))
    if float(difference.mean()) > _MAX_MEAN:
        return False
    height, width = difference.shape
    size = (max(width // _CELL_PX, 1), max(height // _CELL_PX, 1))
    cells = cv2.resize(difference.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return bool(cells.max() <= _MAX_CELL)


def has_same_depth(frame: Frame, before: Frame) -> bool:
    """Whether a sensor, too, gave the same twice; also where neither frame has its depth.

    A colour camera that is covered, or late, does not keep the depth of a sensor from showing the motion.
    """
    if frame.depth_m is None or before.depth_m is None:
        return frame.depth_m is before.depth_m
    return np.array_equal(frame.depth_m, before.depth_m, equal_nan=True)
