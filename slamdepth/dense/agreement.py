# SPDX-License-Identifier: Apache-2.0
"""Whether keyframes find the same surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamdepth.geometry import invert
from slamdepth.types import Camera
from slamdepth.typing import Bools, Floats, Floats32

TOLERANCE = 0.02
"""Relative difference of two depths that still are one surface."""


@dataclass(frozen=True)
class Agreement:
    """What other keyframes say of a keyframe's depth.

    Attributes:
        agree: ``(h, w)`` number of keyframes that see the same surface to 2 %.
        seen: ``(h, w)`` number of keyframes that have any depth there.
        mean_log: ``(h, w)`` mean log ratio of the surface to this depth, over this keyframe and
            those that agree.
    """

    agree: Floats32
    seen: Floats32
    mean_log: Floats32

    @property
    def is_confirmed(self) -> Bools:
        """Where two others, and half of those that look there, agree: one may share this one's error."""
        return np.asarray((self.agree >= 2) & (self.agree >= 0.5 * self.seen - 0.5))


def agreement(
    depth_m: Floats32, T_world_camera: Floats, others: Sequence[tuple[Floats32, Floats]], camera: Camera
) -> Agreement:
    """Compare a keyframe's depth with that of others.

    Args:
        depth_m: ``(h, w)``, 0 where unknown.
        T_world_camera: ``(4, 4)``.
        others: depth ``(h, w)`` and pose ``(4, 4)`` of each.
        camera: pinhole, of all.
    """
    height, width = depth_m.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    rays = (
        (u - np.float32(camera.cx)) / np.float32(camera.fx),
        (v - np.float32(camera.cy)) / np.float32(camera.fy),
    )
    agree, seen, total = (np.zeros(depth_m.shape, np.float32) for _ in range(3))
    for other_m, T_world_other in others:
        T = (invert(T_world_other) @ T_world_camera).astype(np.float32)
        x, y, z = ((T[i, 0] * rays[0] + T[i, 1] * rays[1] + T[i, 2]) * depth_m + T[i, 3] for i in range(3))
        ahead = np.maximum(z, np.float32(1e-3))
        column = np.rint(np.clip(x / ahead * camera.fx + camera.cx, -1, width)).astype(np.int64)
        row = np.rint(np.clip(y / ahead * camera.fy + camera.cy, -1, height)).astype(np.int64)
        inside = (z > 0) & (depth_m > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = np.zeros_like(depth_m)
        found[inside] = other_m[row[inside], column[inside]]
        inside &= found > 0
        ratio = np.log(np.where(inside, found, 1.0) / np.where(inside, ahead, 1.0))
        same = inside & (np.abs(ratio) < TOLERANCE)
        agree += same
        seen += inside
        total += np.where(same, ratio, 0.0)
    return Agreement(agree, seen, total / (agree + 1.0))
