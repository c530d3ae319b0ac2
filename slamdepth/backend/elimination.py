# SPDX-License-Identifier: Apache-2.0
"""The normal equations of a bundle adjustment with the points eliminated (Schur complement).

The Cholesky factor of each point's block does it: with ``Hpp = C C^T``, ``M = C^-1`` and ``Z = Hcp M^T`` the
equations of the cameras are ``Hcc - Z Z^T`` and ``bc - Z M bp``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamdepth.backend.camera_system import CameraSystem
from slamdepth.backend.normal_equations import (
    CAM,
    System,
    coupling,
    motion_of_points,
    moved_with_camera,
)
from slamdepth.backend.point_blocks import inverse_factor, times, times_transposed, transposed_times
from slamdepth.backend.sightings import Sightings
from slamdepth.typing import Floats


@dataclass(frozen=True)
class Step:
    """What to change: cameras ``(K, 7)`` by slot, points ``(3, P)``, readout in s."""

    cameras: Floats
    points: Floats
    readout_s: float


class Eliminated:
    """The equations at one damping.

    Args:
        pull: ``(K,)`` by slot: information on the log depth scale without any observation; 0 for none.
    """

    def __init__(
        self, sightings: Sightings, cameras: CameraSystem, system: System, pull: Floats, damping: float
    ) -> None:
        self._sightings, self._cameras, self._system = sightings, cameras, system
        moving = sightings.moving
        self._M = inverse_factor(system.Hpp, damping)
        M = self._M.take(sightings.pt, axis=1)
        self._V = V = times_transposed(system.W[:3, :, :moving], M[:, :moving])
        scale = times_transposed(system.W[3:], M)[0]
        self._z_fixed = scale[:, moving:]
        Hcc = system.Hcc.copy()
        Hcc[:, 6, 6] += pull
        diagonal = np.arange(CAM)
        Hcc[:, diagonal, diagonal] *= 1.0 + damping
        Hcc[:, diagonal, diagonal] += 1e-6
        P = system.P
        self._solve = cameras.solver(
            Hcc, lambda at: coupling(P[:, at], V[:, :, at], scale[:, at]), self._z_fixed
        )

    def step(self, gradient: Floats) -> Step:
        """The step to the minimum of the quadratic model.

        Args:
            gradient: ``(K,)`` by slot: of the cost by the log depth scale without any observation.
        """
        y = times(self._M, self._system.bp)
        of_slot = self._right_side(self._system.h, y)
        of_slot[:, 6] += gradient
        x = self._solve(self._cameras.packed(of_slot))
        readout_s = 0.0
        if self._system.border is not None:
            w, column, across, corner = self._readout()
            b = self._system.border.br - float((w * y).sum())
            readout_s = (float(column @ x) - b) / corner
            x, y = x + across * readout_s, y + w * readout_s
        delta = self._cameras.unpacked(-x)
        points = -transposed_times(self._M, y + self._back(delta))
        return Step(delta, points, readout_s)

    def readout_variance(self) -> float:
        """Of the readout time in s^2, all cameras and points being free."""
        return 1.0 / max(self._readout()[3], 1e-300)

    def _readout(self) -> tuple[Floats, Floats, Floats, float]:
        """The readout time's equation: its part by point, by unknown, what that moves, and what is left."""
        border = self._system.border
        assert border is not None
        w = times(self._M, border.Hrp)
        column = self._cameras.packed(self._right_side(border.k, w))
        across = self._solve(column)
        return w, column, across, border.Hrr - float((w * w).sum()) + 1e-6 - float(column @ across)

    def _right_side(self, v: Floats, y: Floats) -> Floats:
        """``L v`` summed by slot, less ``Z y``: ``(K, 7)`` for ``(3, N)`` and ``(3, P)``."""
        sightings, P = self._sightings, self._system.P
        y, moving = y.take(sightings.pt, axis=1), sightings.moving
        f = v[:, :moving] - (self._V * y[:, :moving]).sum(axis=1)
        out = sightings.by_slot(moved_with_camera(P[:, :moving], f))
        scale = np.zeros((1, len(sightings)))
        scale[0, moving:] = -(P[:, moving:] * v[:, moving:] + self._z_fixed * y[:, moving:]).sum(axis=0)
        out[sightings.free :, 6] = sightings.by_slot(scale)[sightings.free :, 0]
        return out

    def _back(self, delta: Floats) -> Floats:
        """``Z^T delta`` summed by point, ``(3, P)``, for steps ``(K, 7)`` of the cameras."""
        sightings, moving, free = self._sightings, self._sightings.moving, self._sightings.free
        motion = motion_of_points(self._system.P[:, :moving], sightings.each(delta[:free]))
        back = np.empty((3, len(sightings)))
        back[:, :moving] = (self._V * motion[:, None]).sum(axis=0)
        back[:, moving:] = self._z_fixed * np.repeat(delta[free:, 6], sightings.counts[free:])
        return np.stack([sightings.by_point(row) for row in back])
