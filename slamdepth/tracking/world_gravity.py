# SPDX-License-Identifier: Apache-2.0
"""Which way is down in the world, by what the images of several keyframes tell."""

from __future__ import annotations

import numpy as np

from slamdepth.typing import Floats

_ENOUGH = 6
_AGREEING = 0.7
_SAME = np.cos(np.radians(15.0))
_ASKED_AGAIN = 5


class WorldGravity:
    """Collects directions of gravity; what most agree on is known.

    One image may mistake a wall for the floor. The camera's rotation from keyframe to keyframe is known to
    a degree, so several images tell one direction, and the next need not be asked.
    """

    def __init__(self) -> None:
        self._told: list[Floats] = []
        self._shares: list[float] = []
        self._asked = 0

    def in_camera(self, R_world_camera: Floats) -> Floats | None:
        """Direction of gravity ``(3,)`` in a camera's frame; None where its image had better be asked:
        before enough agree, and every fifth time."""
        self._asked += 1
        down_w = self.in_world()
        if down_w is None or self._asked % _ASKED_AGAIN == 0:
            return None
        return R_world_camera.T @ down_w

    def add(self, R_world_camera: Floats, down: Floats, share: float) -> None:
        """What one image told: ``down (3,)`` in its camera's frame, and how sure that is, 0 to 1."""
        self._told.append(R_world_camera @ down)
        self._shares.append(share)

    def in_world(self) -> Floats | None:
        """The unit direction ``(3,)`` in the world that most agree on; None before enough do."""
        if len(self._told) < _ENOUGH:
            return None
        told, shares = np.stack(self._told), np.array(self._shares)
        alike = told @ told.T > _SAME
        votes = alike @ shares
        best = int(votes.argmax())
        if votes[best] < _AGREEING * shares.sum():
            return None
        mean = shares[alike[best]] @ told[alike[best]]
        return np.asarray(mean / np.linalg.norm(mean))
