# SPDX-License-Identifier: Apache-2.0
"""Projection of rays into the raw image of a camera with lens distortion."""

from __future__ import annotations

import numpy as np

from slamdepth.types import Camera
from slamdepth.typing import Floats

_STEEPEST = 4.0
"""Largest slope considered: 76 degrees off the optical axis."""


def raw_pixels(rays: Floats, camera: Camera) -> Floats:
    """Raw pixels ``(..., 2)`` of the rays ``(..., 3)`` with z > 0.

    A distortion polynomial is fitted inside the image; far outside, it folds back and would show
    the image a second time. Rays beyond that turning point are projected without distortion,
    which puts them outside the image too.
    """
    plane = rays[..., :2] / rays[..., 2:]
    pinhole = plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    if not camera.is_distorted:
        return np.asarray(pinhole)
    import cv2

    flat = np.ascontiguousarray(np.concatenate([plane.reshape(-1, 2), np.ones((plane.size // 2, 1))], axis=1))
    distorted, _ = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
    is_valid = np.linalg.norm(plane, axis=-1) < turning_point(camera)
    return np.where(is_valid[..., None], np.asarray(distorted).reshape(plane.shape), pinhole)


def turning_point(camera: Camera) -> float:
    """The ray slope beyond which the radial distortion of ``camera`` folds back; infinity if never."""
    k1, k2, _, _, k3, *rational = camera.distortion
    r2 = np.linspace(0.0, _STEEPEST, 4001) ** 2
    slope = 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2**2 + 7.0 * k3 * r2**3
    if rational:
        k4, k5, k6 = rational
        above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        slope = slope * below - above * 2.0 * r2 * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))
        slope = np.where(below > 0, slope, 0.0)
    turned = np.flatnonzero(slope <= 0)
    return float(np.sqrt(r2[turned[0]])) if len(turned) else np.inf
