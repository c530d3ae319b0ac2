# SPDX-License-Identifier: Apache-2.0
"""The axes in which a path and a map are drawn: level where gravity is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from slamdepth.typing import Floats

_LEAST_LEVEL = 0.2  # sine of the angle to gravity below which a direction does not define "forward"


@dataclass(frozen=True)
class View:
    """A projection of points onto two axes.

    Attributes:
        title: what is seen, in a few words.
        across, up: ``(3,)`` unit vectors in the world frame, to the right and upwards in the plot.
        labels: of the plot's axes, with their unit.
    """

    title: str
    across: Floats
    up: Floats
    labels: tuple[str, str]

    def flat(self, points: Floats) -> Floats:
        """``points (N, 3)`` of the world as ``(N, 2)`` metres to the right and upwards."""
        return np.asarray(points @ np.stack([self.across, self.up], axis=1))

    def frame(self, panel: Any, points: Floats, title: str | None = None) -> None:
        """Give a plot of this view its title, equal scales, and limits a little wider than the points.

        Args:
            panel: matplotlib axes.
            points: ``(N, 2)`` of :meth:`flat`; NaN where a line is broken.
            title: None takes that of the view.
        """
        from matplotlib.ticker import MaxNLocator

        points = points[np.isfinite(points).all(axis=1)]
        low, high = points.min(axis=0), points.max(axis=0)
        half = max(0.55 * float((high - low).max()), 0.01)
        x, y = (low + high) / 2
        panel.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
        panel.set(title=title or self.title, xlabel=self.labels[0], ylabel=self.labels[1])
        panel.set_aspect("equal", adjustable="box")
        panel.xaxis.set_major_locator(MaxNLocator(6))
        panel.yaxis.set_major_locator(MaxNLocator(6))


def drawing_views(gravity_w: Floats | None) -> tuple[View, View]:
    """Two views of the world frame, whose own axes are the first camera's (x right, y down, z forward).

    Args:
        gravity_w: ``(3,)`` unit direction of gravity in the world. With it, the views are from above and
            from the side of a level scene; with None, they are along the first camera's own axes.
    """
    x, y, z = np.eye(3)
    if gravity_w is None:
        return (
            View("first camera's x–z", x, z, ("x, right in its image (m)", "z, where it looks (m)")),
            View("first camera's z–y", z, -y, ("z, where it looks (m)", "−y, up in its image (m)")),
        )
    right, down, forward = level_axes(gravity_w)
    return (
        View("from above (gravity-aligned)", right, forward, ("right (m)", "forward (m)")),
        View("from the side (gravity-aligned)", forward, -down, ("forward (m)", "up (m)")),
    )


def about_views(gravity_w: Floats | None) -> str:
    """A sentence for the caption of plots by :func:`drawing_views`."""
    if gravity_w is None:
        return (
            "Drawn along the axes of the first camera: gravity is not known, so a level table is drawn as "
            "steep as that camera was tipped."
        )
    return (
        "Up is against gravity, which the depth model estimated from the images of the keyframes to within a "
        "few degrees; forward is where the first camera looked, made level."
    )


def level_axes(gravity_w: Floats) -> Floats:
    """``R_level_world (3, 3)``: rows are right, down and forward in the world frame.

    Forward is where the first camera looked, made level. If it looked straight down or up, forward is where
    it would look after being tipped back to level.

    Args:
        gravity_w: ``(3,)`` unit direction of gravity in the world, whose axes are the first camera's.
    """
    ahead = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(gravity_w, ahead)) < _LEAST_LEVEL:
        ahead = np.array([0.0, -np.sign(gravity_w[2]), 0.0])
    right = np.cross(gravity_w, ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, gravity_w, np.cross(right, gravity_w)])
