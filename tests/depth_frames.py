# SPDX-License-Identifier: Apache-2.0
"""A frame of noise for depth networks."""

from __future__ import annotations

import numpy as np

from slamdepth.types import Camera, Frame


def frame_of(width: int = 64, height: int = 48, focal: float = 60.0, focal_y: float | None = None) -> Frame:
    """The same noise each time; ``focal_y`` differs from ``focal`` where it is given."""
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Frame(3, 0.1, image, Camera(width, height, focal, focal_y or focal, width / 2, height / 2))
