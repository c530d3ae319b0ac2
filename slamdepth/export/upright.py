# SPDX-License-Identifier: Apache-2.0
"""Frames that stand upright, for tools that have a vertical axis."""

from __future__ import annotations

import numpy as np

from slamdepth.export.scene import ExportScene
from slamdepth.report.axes import level_axes
from slamdepth.report.viewpoints import guessed_gravity
from slamdepth.typing import Floats


def z_up(scene: ExportScene) -> Floats:
    """``T_upright_world``, ``(4, 4)``: a rotation to x right, y ahead and z up, as the first camera looks.

    By gravity, or, where it is unknown, by how the cameras are held on average.
    """
    gravity_w = scene.gravity_w
    if gravity_w is None:
        gravity_w = guessed_gravity(scene.trajectory.T_world_camera)
    right, down, ahead = level_axes(gravity_w)
    T: Floats = np.eye(4)
    T[:3, :3] = [right, ahead, -down]
    return T


def y_up(scene: ExportScene) -> Floats:
    """``T_upright_world``, ``(4, 4)``: glTF's axes, x right and y up; the first camera looks along -z."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    return np.asarray(turn @ z_up(scene), np.float64)
