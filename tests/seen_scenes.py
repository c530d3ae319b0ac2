# SPDX-License-Identifier: Apache-2.0
"""What images along a path see with a camera that is known exactly."""

from __future__ import annotations

import numpy as np

from slamdepth.backend.sights import Sights
from slamdepth.geometry import se3_exp, transform
from slamdepth.types import Camera
from slamdepth.typing import Floats

CAMERA = Camera(640, 480, 480.0, 480.0, 319.5, 239.5, (0.08, -0.03, 0.0, 0.0, 0.0))
IMAGES, POINTS = 12, 250

PATHS = {
    "hand": np.array([-0.1, 0.03, 0.02, 0.03, -0.05, 0.04]),
    "forward": np.array([0.0, 0.0, -0.08, 0.0, 0.0, 0.0]),
    "turning": np.array([0.0, 0.0, 0.0, 0.02, -0.06, 0.03]),
    "sideways": np.array([-0.08, 0.0, 0.0, 0.0, 0.0, 0.0]),
}
"""Step from image to image: metres and radians."""


def pixels(camera: Camera, points_c: Floats) -> Floats:
    """Raw pixels ``(N, 2)`` of points in the camera's frame."""
    x, y = (points_c[:, :2] / points_c[:, 2:]).T
    q = x * x + y * y
    d = 1.0 + q * (camera.distortion[0] + q * camera.distortion[1])
    return np.column_stack([camera.fx * x * d + camera.cx, camera.fy * y * d + camera.cy])


def scene(
    path: str = "hand", camera: Camera = CAMERA, noise_px: float = 0.4, seed: int = 0, off: float = 0.01
) -> Sights:
    """What images along a path see, and where images and points are thought to be."""
    rng = np.random.default_rng(seed)
    X = rng.uniform((-2.5, -2.0, 2.0), (2.5, 2.0, 6.0), (POINTS, 3))
    steps = np.outer(np.arange(IMAGES) - IMAGES / 2, PATHS[path]) + 0.003 * rng.normal(size=(IMAGES, 6)) * (
        PATHS[path] != 0
    )
    T = np.stack([se3_exp(step) for step in steps])
    parts = []
    for k in range(IMAGES):
        P = transform(T[k], X)
        px = pixels(camera, P)
        inside = (P[:, 2] > 0.3) & (px >= 0).all(axis=1) & (px < (camera.width, camera.height)).all(axis=1)
        inside &= (P[:, :2] ** 2).sum(axis=1) < P[:, 2] ** 2
        at = np.flatnonzero(inside)
        parts.append((np.full(len(at), k), at, px[at] + noise_px * rng.normal(size=(len(at), 2))))
    obs_camera, obs_point, raw_px = (np.concatenate(each) for each in zip(*parts, strict=True))
    often = np.bincount(obs_point, minlength=POINTS) >= 3
    keep, row = often[obs_point], np.cumsum(often) - 1
    depth = 1.0 + 5 * off * rng.normal(size=(POINTS, 1))
    return Sights(
        se3_exp(off * rng.normal(size=(IMAGES, 6))) @ T,
        np.zeros(IMAGES, dtype=np.int64),
        (X * depth)[often],
        obs_camera[keep],
        row[obs_point[keep]],
        raw_px[keep],
        np.ones(int(keep.sum())),
        np.zeros((int(keep.sum()), 2)),
    )
