# SPDX-License-Identifier: Apache-2.0
"""The axes in which a path and a map are drawn: upright where gravity is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.typing import Floats

_LEAST_LEVEL = 0.2  # sine of the angle to gravity below which a direction is no way forward


@dataclass(frozen=True)
class View:
    """Two coordinates of points as a flat picture.

    Attributes:
        across, up: ``(3,)`` unit vectors in the world frame, to the right and upwards in the picture.
        labels: of the picture's axes, with their unit.
    """

    title: str
    across: Floats
    up: Floats
    labels: tuple[str, str]

    def flat(self, points: Floats) -> Floats:
        """``points (N, 3)`` of the world as ``(N, 2)`` metres to the right and upwards."""
        return np.asarray(points @ np.stack([self.across, self.up], axis=1))


def drawing_views(down_w: Floats | None) -> tuple[View, View]:
    """Two views of the world frame, whose own axes are the first camera's (x right, y down, z forward).

    Args:
        down_w: ``(3,)`` unit direction of gravity in the world. With it, the views are from above and
            from the side of a level scene; without, they are along the first camera's own axes.
    """
    x, y, z = np.eye(3)
    if down_w is None:
        return (
            View("first camera's x–z", x, z, ("x, right in its image (m)", "z, where it looks (m)")),
            View("first camera's z–y", z, -y, ("z, where it looks (m)", "−y, up in its image (m)")),
        )
    right, down, forward = level_axes(down_w)
    return (
        View("from above (gravity-aligned)", right, forward, ("right (m)", "forward (m)")),
        View("from the side (gravity-aligned)", forward, -down, ("forward (m)", "up (m)")),
    )


def about_views(down_w: Floats | None) -> str:
    """A sentence for the caption of pictures by :func:`drawing_views`."""
    if down_w is None:
        return (
            "Drawn along the axes of the first camera: which way is up is not known, so a level table "
            "is drawn as steep as that camera was tipped."
        )
    return (
        "Up is against gravity, which the depth model found in the images of the keyframes to within a few "
        "degrees; forward is where the first camera looked, made level."
    )


def level_axes(down_w: Floats) -> Floats:
    """``R_level_world (3, 3)``: rows are right, down and forward in the world frame.

    Forward is where the first camera looked, made level; where it looked straight down or up, where it
    would look after being tipped back to level.

    Args:
        down_w: ``(3,)`` unit direction of gravity in the world, whose axes are the first camera's.
    """
    ahead = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(down_w, ahead)) < _LEAST_LEVEL:
        ahead = np.array([0.0, -np.sign(down_w[2]), 0.0])
    right = np.cross(down_w, ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, down_w, np.cross(right, down_w)])
