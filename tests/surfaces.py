# SPDX-License-Identifier: Apache-2.0
"""Exact surfaces for the tests of their scores."""

from __future__ import annotations

import numpy as np

from slamdepth.evaluation import Surface


def wall(z_m: float, width_m: float = 1.0, height_m: float = 1.0, patches: int = 10) -> Surface:
    """A rectangle from the origin along x and y at ``z_m``, of ``patches`` squared pairs of triangles."""
    x, y = np.meshgrid(np.linspace(0, width_m, patches + 1), np.linspace(0, height_m, patches + 1))
    vertices = np.stack([x, y, np.full_like(x, z_m)], axis=-1).reshape(-1, 3)
    corner = (np.arange(patches)[:, None] * (patches + 1) + np.arange(patches)).ravel()
    below = corner + patches + 1
    triangles = np.concatenate(
        [np.stack([corner, corner + 1, below], 1), np.stack([corner + 1, below + 1, below], 1)]
    )
    return Surface(vertices.astype(np.float32), triangles)


def sphere(radius_m: float, rings: int = 200) -> Surface:
    """A sphere about the origin."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, rings))
    points = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    grid = wall(0.0, patches=rings - 1)
    return Surface((radius_m * points.reshape(-1, 3)).astype(np.float32), grid.triangles)


def joined(first: Surface, second: Surface) -> Surface:
    """Both surfaces as one."""
    return Surface(
        np.concatenate([first.vertices_m, second.vertices_m]),
        np.concatenate([first.triangles, second.triangles + len(first.vertices_m)]),
    )
