# SPDX-License-Identifier: Apache-2.0
"""What images see, and how a lens with a focal length and two radial coefficients shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.typing import Floats, Ints

NEAREST = 1e-6
_WRONG = 1e3  # whitened residual of what no lens shows


@dataclass(frozen=True)
class Sights:
    """What the images of one or several maps see; each map has its own world frame.

    Attributes:
        T_camera_world: ``(K, 4, 4)`` in any unit of length.
        group: ``(K,)`` map that each image is in.
        points_w: ``(P, 3)``.
        obs_camera, obs_point: ``(M,)`` indices; an image sees a point at most once.
        raw_px: ``(M, 2)`` pixels as taken, corrected for the shutter as far as its readout time is known.
        sigma_px: ``(M,)`` deviations.
        px_rate: ``(M, 2)`` pixels by which a second of readout time moves each.
    """

    T_camera_world: Floats
    group: Ints
    points_w: Floats
    obs_camera: Ints
    obs_point: Ints
    raw_px: Floats
    sigma_px: Floats
    px_rate: Floats

    @staticmethod
    def joined(parts: Sequence[Sights]) -> Sights:
        """Several as one."""
        cameras = np.cumsum([0, *(len(part.T_camera_world) for part in parts)])
        points = np.cumsum([0, *(len(part.points_w) for part in parts)])
        groups = np.cumsum([0, *(int(part.group.max(initial=-1)) + 1 for part in parts)])
        return Sights(
            np.concatenate([part.T_camera_world for part in parts]),
            np.concatenate([part.group + first for part, first in zip(parts, groups, strict=False)]),
            np.concatenate([part.points_w for part in parts]),
            np.concatenate([part.obs_camera + first for part, first in zip(parts, cameras, strict=False)]),
            np.concatenate([part.obs_point + first for part, first in zip(parts, points, strict=False)]),
            np.concatenate([part.raw_px for part in parts]),
            np.concatenate([part.sigma_px for part in parts]),
            np.concatenate([part.px_rate for part in parts]),
        )


@dataclass(frozen=True)
class Seen:
    """``M`` observations as a state predicts them.

    Attributes:
        r: ``(M, 2)`` whitened residuals; P: ``(M, 3)`` points in the camera frame.
        x, y, q: ``(M,)`` X/Z, Y/Z and the sum of their squares.
    """

    r: Floats
    P: Floats
    x: Floats
    y: Floats
    q: Floats

    @property
    def chi2(self) -> Floats:
        """Squared whitened residuals ``(M,)``."""
        return np.asarray(np.einsum("ni,ni->n", self.r, self.r))


@dataclass(frozen=True)
class Lens:
    """The unknowns that all images share.

    Attributes:
        theta: ``(6,)`` log of the focal length, k1, k2, the centre in pixels, and what is added to the
            readout time in seconds.
        aspect: fy / fx.
    """

    theta: Floats
    aspect: float

    def look(self, sights: Sights, T_camera_world: Floats, points_w: Floats) -> Seen:
        """The observations of images ``(K, 4, 4)`` and points ``(P, 3)``."""
        T = T_camera_world[sights.obs_camera]
        P = np.einsum("nij,nj->ni", T[:, :3, :3], points_w[sights.obs_point]) + T[:, :3, 3]
        z = np.maximum(P[:, 2], NEAREST)
        x, y = P[:, 0] / z, P[:, 1] / z
        q = x * x + y * y
        log_f, k1, k2, cx, cy, readout_s = self.theta
        f, d = np.exp(log_f), 1.0 + q * (k1 + q * k2)
        px = np.column_stack([f * x * d + cx, self.aspect * f * y * d + cy])
        r = (px - sights.raw_px - readout_s * sights.px_rate) / sights.sigma_px[:, None]
        # behind the camera, or where the lens would fold and show two directions in one pixel
        r[(P[:, 2] <= NEAREST) | (1.0 + q * (3.0 * k1 + 5.0 * q * k2) <= 0.0)] = _WRONG
        return Seen(r, P, x, y, q)

    def by_unknowns(self, seen: Seen, by_readout: Floats) -> Floats:
        """Derivative ``(M, 2, 6)`` of the pixels by the unknowns; ``by_readout (M, 2)`` is the last one."""
        x, y, q = seen.x, seen.y, seen.q
        f = np.exp(self.theta[0])
        fy = self.aspect * f
        d = 1.0 + q * (self.theta[1] + q * self.theta[2])
        one, zero = np.ones_like(x), np.zeros_like(x)
        u = np.column_stack([f * x * d, f * x * q, f * x * q * q, one, zero, by_readout[:, 0]])
        v = np.column_stack([fy * y * d, fy * y * q, fy * y * q * q, zero, one, by_readout[:, 1]])
        return np.stack([u, v], axis=1)

    def by_point(self, seen: Seen) -> Floats:
        """Derivative ``(M, 2, 3)`` of the pixels by the points in the camera frame."""
        x, y, q = seen.x, seen.y, seen.q
        f = np.exp(self.theta[0])
        fy = self.aspect * f
        k1, k2 = self.theta[1:3]
        d, slope = 1.0 + q * (k1 + q * k2), 2.0 * (k1 + 2.0 * q * k2)
        A = np.empty((len(x), 2, 3))
        A[:, 0, 0], A[:, 0, 1] = f * (d + x * x * slope), f * x * y * slope
        A[:, 1, 0], A[:, 1, 1] = fy * x * y * slope, fy * (d + y * y * slope)
        A[:, :, 2] = -(A[:, :, 0] * x[:, None] + A[:, :, 1] * y[:, None])
        A /= np.maximum(seen.P[:, 2], NEAREST)[:, None, None]
        return A
