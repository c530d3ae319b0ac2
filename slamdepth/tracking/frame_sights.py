# SPDX-License-Identifier: Apache-2.0
"""What a placed frame sees of its map."""

from __future__ import annotations

from dataclasses import dataclass

from slamdepth.typing import Floats, Ints

FEWEST_SIGHTS = 30
"""Landmarks by which a frame's pose is refined, at least."""


@dataclass(frozen=True)
class FrameSights:
    """Landmarks that a placed frame sees.

    Attributes:
        T_camera_world: ``(4, 4)`` of the frame.
        landmark_ids: ``(N,)``.
        points_w: ``(N, 3)`` metres, world frame.
        px: ``(N, 2)`` undistorted pixels at the time of the middle row; sigma_px: ``(N,)``.
    """

    T_camera_world: Floats
    landmark_ids: Ints
    points_w: Floats
    px: Floats
    sigma_px: Floats

    def __len__(self) -> int:
        return len(self.landmark_ids)
