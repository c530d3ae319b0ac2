# SPDX-License-Identifier: Apache-2.0
"""Scenes made up for tests of pages, viewers and videos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import leave_out_plots
from report_data import full_data, several_maps_data

from slamdepth.io import write_tum_trajectory
from slamdepth.mapping.mesh import Mesh
from slamdepth.report import ReportData, write_report
from slamdepth.report.scene import SCENE_FILE, Scene, scene_of, write_scene

RED, GREEN, BLUE = (200, 40, 40), (40, 170, 60), (50, 60, 190)


def room_mesh(cells: int = 12) -> Mesh:
    """A floor (blue), a wall ahead (red) and one to the left (green), seen from within: y is down."""
    parts = []
    n = np.arange(cells + 1) * (4.0 / cells) - 2.0
    u, v = (grid.ravel() for grid in np.meshgrid(n, n))
    flat = np.zeros_like(u)
    sides = (
        (np.stack([u, flat + 1.5, v], axis=1), BLUE),  # seen from above
        (np.stack([u, -v - 0.5, flat + 2.0], axis=1), RED),  # seen from smaller z
        (np.stack([flat - 2.0, u - 0.5, v], axis=1), GREEN),  # seen from larger x
    )
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + cells + 1], axis=1),
            np.stack([corner + 1, corner + cells + 2, corner + cells + 1], axis=1),
        ]
    )
    inside = np.array([0.0, 0.0, 0.0])
    for number, (vertices, colour) in enumerate(sides):
        a, b, c = (vertices[faces[0, k]] for k in range(3))
        front = np.cross(b - a, c - a) @ (inside - a) > 0
        parts.append((vertices, faces if front else faces[:, ::-1], colour, number * len(u)))
    return Mesh(
        np.concatenate([p[0] for p in parts]).astype(np.float32),
        np.concatenate([p[1] + p[3] for p in parts]).astype(np.int32),
        np.concatenate([np.tile(np.array(p[2]) / 255, (len(u), 1)) for p in parts]).astype(np.float32),
    )


def room_scene() -> Scene:
    data = full_data()
    run = replace(data.reconstruction, loops=((0, 5), (1, 4)), gravity_w=np.array([0.0, 1.0, 0.0]))
    return scene_of(run, [room_mesh()], [data.trajectory_score])


def data_with_scene() -> ReportData:
    return replace(full_data(), scene=room_scene())


def several_maps_with_scene() -> ReportData:
    data = several_maps_data()
    run = data.reconstruction
    first, *rest = run.others
    others = (replace(first, keyframes=run.keyframes[:3]), *rest)
    return replace(data, scene=scene_of(replace(run, others=others), [room_mesh(), None, None], []))


def write_run(folder: Path) -> Path:
    """The folder of a made-up run, as the pipeline writes it."""
    folder.mkdir()
    data = data_with_scene()
    assert data.scene is not None
    one = data.scene.maps[0]
    with pytest.MonkeyPatch.context() as patch:
        leave_out_plots(patch)
        write_report(folder, data)
    write_scene(folder / SCENE_FILE, data.scene)
    write_tum_trajectory(folder / "trajectory.txt", one.path)
    write_tum_trajectory(folder / "keyframes.txt", one.keyframes)
    room_mesh().save(folder / "mesh.ply")
    return folder
