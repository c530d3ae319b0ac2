# SPDX-License-Identifier: Apache-2.0
"""The lens models that a board can calibrate, and their projection as a function of the intrinsics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamdepth.calibration import WideLens
from slamdepth.types import Camera
from slamdepth.typing import Floats

PINHOLE_NAMES = ("fx", "fy", "cx", "cy")
_NEAREST = 1e-6


@dataclass(frozen=True)
class LensModel:
    """A lens model with free intrinsics.

    Attributes:
        name: as in a camera file.
        coefficients: names of what follows ``fx, fy, cx, cy``.
        plane: positions ``(N, 2)`` on the image plane of points ``(N, 3)`` of the camera frame.
        radius: distance from the principal point, in focal lengths, at an angle to the optical axis.
    """

    name: str
    coefficients: tuple[str, ...]
    plane: Callable[[Floats, Floats], Floats]
    radius: Callable[[float], float]

    @property
    def names(self) -> tuple[str, ...]:
        return PINHOLE_NAMES + self.coefficients

    def project(self, values: Floats, points_c: Floats) -> Floats:
        """Raw pixels ``(N, 2)`` of points ``(N, 3)`` by the intrinsics ``values``."""
        fx, fy, cx, cy = values[:4]
        return np.asarray(self.plane(points_c, values[4:]) * [fx, fy] + [cx, cy])

    def camera(self, values: Floats, width: int, height: int) -> Camera:
        """The camera with these intrinsics.

        Raises:
            CameraError: no camera has them.
        """
        fx, fy, cx, cy, *numbers = (float(value) for value in values)
        if self.name == FISHEYE.name:
            return Camera(width, height, fx, fy, cx, cy, lens=WideLens("fisheye", tuple(numbers)))
        return Camera(width, height, fx, fy, cx, cy, tuple(numbers))


def _brown(points_c: Floats, numbers: Floats) -> Floats:
    k1, k2, p1, p2, k3 = numbers
    x, y = (points_c[:, :2] / np.maximum(points_c[:, 2:], _NEAREST)).T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def _fisheye(points_c: Floats, numbers: Floats) -> Floats:
    k1, k2, k3, k4 = numbers
    side = np.hypot(points_c[:, 0], points_c[:, 1])
    theta = np.arctan2(side, points_c[:, 2])
    t2 = theta * theta
    rho = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return np.asarray(points_c[:, :2] * (rho / np.maximum(side, 1e-12))[:, None])


BROWN_CONRADY = LensModel("brown_conrady", ("k1", "k2", "p1", "p2", "k3"), _brown, math.tan)
FISHEYE = LensModel("fisheye", ("k1", "k2", "k3", "k4"), _fisheye, float)
