# SPDX-License-Identifier: Apache-2.0
"""From a frame of any size to the network's input, and its focal length there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import CameraError
from slamdepth.types import Camera, Frame

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

PATCH = 14
INPUT_PX = 196 * 266
"""Pixels of the network's input that the shipped head was trained with."""

CANONICAL_FOCAL_PX = 280.0
"""Focal length, in pixels of the network's input, at which log depth is predicted.

Through a lens of twice the focal length things look half as far away, so the network predicts
``z * CANONICAL_FOCAL_PX / f``, and a factor of ``f / CANONICAL_FOCAL_PX`` gives metres.
"""

SMALLEST_SIDE = 28
LARGEST_ASPECT = 6.0


def check_size(frame: Frame) -> None:
    """Check that the image of ``frame`` is large and wide enough for a network.

    Raises:
        CameraError: a side is below 28 pixels, or the aspect above 6:1.
    """
    height, width = frame.image_rgb.shape[:2]
    if min(height, width) < SMALLEST_SIDE or max(height, width) > LARGEST_ASPECT * min(height, width):
        raise CameraError(
            f"frame {frame.index}: {width}x{height} pixels; the depth network needs sides of at least "
            f"{SMALLEST_SIDE} pixels and an aspect of at most {LARGEST_ASPECT:g}:1"
        )


def input_size(height: int, width: int, input_px: int = INPUT_PX) -> tuple[int, int]:
    """Rows and columns of the network's input for a ``height`` x ``width`` image.

    They are multiples of 14 that keep the aspect, with a product of about ``input_px``.
    """
    scale = math.sqrt(input_px / (height * width))
    rows = max(1, round(height * scale / PATCH)) * PATCH
    columns = max(1, round(width * scale / PATCH)) * PATCH
    return rows, columns


def focal_px_at(camera: Camera, rows: int, columns: int) -> float:
    """Focal length in pixels of ``camera``'s image resized to ``rows`` x ``columns``.

    It is the geometric mean over both axes.
    """
    scaled = camera.scaled(columns, rows)
    return math.sqrt(scaled.fx * scaled.fy)


def resize_rgb(image_rgb: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """``image_rgb (H, W, 3)`` resized to ``rows`` x ``columns``: by area where it shrinks, else bicubic."""
    import cv2

    if image_rgb.shape[:2] == (rows, columns):
        return image_rgb
    interpolation = cv2.INTER_AREA if rows < image_rgb.shape[0] else cv2.INTER_CUBIC
    resized = cv2.resize(image_rgb, (columns, rows), interpolation=interpolation)
    return np.asarray(resized, dtype=np.uint8)


def normalised(images_rgb: NDArray[np.uint8], device: str) -> torch.Tensor:
    """Images ``(B, H, W, 3)`` uint8 as a tensor ``(B, 3, H, W)``, ImageNet-normalised, on ``device``."""
    import torch

    from slamdepth.depth.dinov2 import IMAGENET_MEAN, IMAGENET_STD

    x = torch.from_numpy(np.ascontiguousarray(images_rgb)).to(device).permute(0, 3, 1, 2).float() / 255.0
    mean = torch.tensor(IMAGENET_MEAN, device=device).view(1, 3, 1, 1)
    std = torch.tensor(IMAGENET_STD, device=device).view(1, 3, 1, 1)
    return ((x - mean) / std).contiguous()
