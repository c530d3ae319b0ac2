# SPDX-License-Identifier: Apache-2.0
"""Downscaling of large recordings, and of their camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.types import Camera

LONGEST_SIDE_PX = 640
"""Larger frames are reduced to this, which tracking is tuned to and a laptop is fast enough for."""


def reduced_camera(camera: Camera, notes: list[str]) -> Camera:
    """``camera`` for images whose longest side is at most :data:`LONGEST_SIDE_PX`.

    Images of a wide lens keep their size: their pinhole view is made of all their pixels.

    Args:
        notes: takes a line where the size changes.
    """
    if camera.lens is not None:
        return camera
    share = min(1.0, LONGEST_SIDE_PX / max(camera.width, camera.height))
    width, height = max(1, round(share * camera.width)), max(1, round(share * camera.height))
    if share < 1.0:
        notes.append(f"frames of {camera.width}x{camera.height} are reduced to {width}x{height} pixels")
    return camera.scaled(width, height)


def reduced_image(image_rgb: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """``image_rgb (H, W, 3)`` uint8, resized to the size of ``camera``."""
    import cv2

    if image_rgb.shape[:2] == (camera.height, camera.width):
        return image_rgb
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
