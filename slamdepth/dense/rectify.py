# SPDX-License-Identifier: Apache-2.0
"""Images as a pinhole camera with a global shutter would have taken them, at the working size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.frontend.rolling_shutter import at_middle_row, row_phase
from slamdepth.types import Camera
from slamdepth.typing import Bytes, Floats, Floats32

_STEPS = 2  # fixed-point iterations: the shutter moves pixels by a few pixels, smoothly


@dataclass(frozen=True)
class Rectifier:
    """Removes lens distortion and rolling shutter, and reduces the size.

    Attributes:
        raw: the camera of the images, at the working size.
        readout_s: readout time of the shutter in seconds, 0 for a global one.
    """

    raw: Camera
    readout_s: float

    @classmethod
    def of(cls, camera: Camera, width: int, readout_s: float) -> Rectifier:
        """A rectifier to images at most ``width`` pixels along their longer side."""
        share = min(1.0, width / max(camera.width, camera.height))
        size = max(8, round(camera.width * share)), max(8, round(camera.height * share))
        return cls(camera.scaled(*size), readout_s)

    @property
    def camera(self) -> Camera:
        """The pinhole camera of the rectified images."""
        return self.raw.without_distortion()

    def positions(self, velocity: Floats | None, inverse_depth: float) -> Floats32 | None:
        """Where in the raw image, at the working size, the rectified pixels come from.

        Args:
            velocity: ``(6,)``, see :func:`slamdepth.frontend.rolling_shutter.velocity_between`; None for a
                camera at rest.
            inverse_depth: 1/m, of the scene in general.

        Returns:
            ``(h, w, 2)`` float32 pixels; None where they are the same pixels.
        """
        shutter = velocity is not None and self.readout_s != 0.0
        if not shutter and not self.raw.is_distorted:
            return None
        u, v = np.meshgrid(np.arange(self.raw.width), np.arange(self.raw.height))
        target = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        px = target
        if shutter and velocity is not None:
            inverse = np.full(len(px), inverse_depth)
            for _ in range(_STEPS):
                phase = row_phase(px, self.raw)
                px = target - (at_middle_row(self.camera, px, phase, inverse, velocity, self.readout_s) - px)
        if self.raw.is_distorted:
            px = _distorted(self.raw, px)
        return np.ascontiguousarray(px.reshape(self.raw.height, self.raw.width, 2), np.float32)

    def small(self, image: Bytes) -> Bytes:
        """An image ``(H, W[, 3])`` uint8 at the working size."""
        import cv2

        size = (self.raw.width, self.raw.height)
        if (image.shape[1], image.shape[0]) == size:
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def grey(self, image_rgb: Bytes, positions: Floats32 | None) -> Bytes:
        """Rectified grey values ``(h, w)`` uint8, 1 to 255; 0 where the image shows nothing."""
        import cv2

        grey = np.maximum(cv2.cvtColor(self.small(image_rgb), cv2.COLOR_RGB2GRAY), 1)
        if positions is None:
            return np.asarray(grey, np.uint8)
        return np.asarray(cv2.remap(grey, *_split(positions), cv2.INTER_LINEAR, borderValue=0), np.uint8)

    def color(self, image_rgb: Bytes, positions: Floats32 | None) -> Bytes:
        """Rectified colours ``(h, w, 3)`` uint8."""
        import cv2

        small = self.small(image_rgb)
        if positions is None:
            return small
        image = cv2.remap(small, *_split(positions), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(image, np.uint8)

    def nearest(self, values: Floats32, positions: Floats32 | None) -> Floats32:
        """A map ``(H, W)`` of the raw image rectified ``(h, w)`` by nearest neighbour, 0 outside it."""
        import cv2

        sx, sy = values.shape[1] / self.raw.width, values.shape[0] / self.raw.height
        if positions is None:
            u, v = np.meshgrid(np.arange(self.raw.width), np.arange(self.raw.height))
            positions = np.stack([u, v], axis=2).astype(np.float32)
        full = (positions + np.float32(0.5)) * np.array([sx, sy], np.float32) - np.float32(0.5)
        return np.asarray(cv2.remap(values, *_split(full), cv2.INTER_NEAREST, borderValue=0), np.float32)


def _split(positions: Floats32) -> tuple[Floats32, Floats32]:
    return np.ascontiguousarray(positions[..., 0]), np.ascontiguousarray(positions[..., 1])


def _distorted(camera: Camera, px: Floats) -> Floats:
    """Raw pixels ``(N, 2)`` of undistorted ones."""
    import cv2

    rays = np.column_stack(
        [(px[:, 0] - camera.cx) / camera.fx, (px[:, 1] - camera.cy) / camera.fy, np.ones(len(px))]
    )
    raw, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
    return np.asarray(raw[:, 0], np.float64)
