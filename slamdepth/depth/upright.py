# SPDX-License-Identifier: Apache-2.0
"""Images rotated upright about their centre, and predictions for them rotated back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slamdepth.types import Camera, DepthPrediction
from slamdepth.typing import Floats

_BEYOND, _BEYOND_PER_SIDE = 0.15, 1.0
"""Deviation of log depth where it is extrapolated, in addition to that of the nearest pixel seen: at the
border of what was seen, and for each distance of the image's longer side from there."""


def roll_rad(gravity: Floats) -> float:
    """Roll of a camera in radians: the angle of gravity in the image from its vertical axis.

    Args:
        gravity: ``(3,)`` in the camera's frame (x right, y down, z forward); an angle towards the right side
            of the image is positive.
    """
    return float(np.arctan2(gravity[0], gravity[1]))


@dataclass(frozen=True)
class UprightView:
    """What is seen of a rolled camera's image after a rotation upright.

    The view has the image's area and pixel size, and the aspect of the rotated image's bounding box, so a
    quarter turn of a landscape image is a portrait one. Corners of the image that lie outside are not seen.

    Attributes:
        camera: of the image as taken.
        roll_rad: its roll, which is undone.
    """

    camera: Camera
    roll_rad: float

    @cached_property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the view."""
        width, height = self.camera.width, self.camera.height
        cosine, sine = abs(math.cos(self.roll_rad)), abs(math.sin(self.roll_rad))
        columns, rows = width * cosine + height * sine, width * sine + height * cosine
        scale = math.sqrt(width * height / (columns * rows))
        return max(1, round(rows * scale)), max(1, round(columns * scale))

    @cached_property
    def _M_view_image(self) -> Floats:
        """``(2, 3)`` affine map of pixels."""
        rows, columns = self.size
        centre = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        M = np.asarray(cv2.getRotationMatrix2D(centre, -math.degrees(self.roll_rad), 1.0), dtype=np.float64)
        M[:, 2] += (columns - 1) / 2 - centre[0], (rows - 1) / 2 - centre[1]
        return M

    def rotated(self, image_rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The view of an image ``(H, W, 3)``; mirrored where it reaches beyond the image's border."""
        out = cv2.warpAffine(
            image_rgb, self._M_view_image, self.size[::-1], flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )  # fmt: skip
        return np.asarray(out, dtype=np.uint8)

    def rotated_back(self, upright: DepthPrediction) -> DepthPrediction:
        """A prediction for the view, as one for every pixel of the image as taken.

        Pixels that the view does not show get the depth of the nearest one that it does, and the larger
        deviation of a guess.
        """
        values = self._back(upright.values, cv2.BORDER_REPLICATE)
        sigma = upright.sigma_log
        if sigma is not None:
            sigma = self._back(sigma, cv2.BORDER_REPLICATE)
            is_seen = self._back(np.ones(self.size, np.uint8), cv2.BORDER_CONSTANT)
            if not is_seen.all():
                to_seen_px = cv2.distanceTransform(1 - is_seen, cv2.DIST_L2, 5)
                beyond = _BEYOND + _BEYOND_PER_SIDE * to_seen_px / max(is_seen.shape)
                sigma = np.where(is_seen, sigma, np.hypot(sigma, beyond)).astype(np.float32)
        return replace(upright, values=values, sigma_log=sigma)

    def _back(self, values: NDArray[Any], border: int) -> NDArray[Any]:
        size = self.camera.width, self.camera.height
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(values, self._M_view_image, size, flags=flags, borderMode=border))
