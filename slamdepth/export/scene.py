# SPDX-License-Identifier: Apache-2.0
"""What is exported: the cameras, poses, keypoints and points of one map, wherever they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.types import Camera, Trajectory
from slamdepth.typing import Floats, Ints


@dataclass(frozen=True)
class View:
    """An image with a pose.

    Attributes:
        timestamp_s: when it was taken; names the frame of the recording.
        T_world_camera: ``(4, 4)``.
        keypoints_px: ``(N, 2)`` raw pixels of the tracker's camera; none where they were not kept.
        point_rows: ``(N,)`` row of each keypoint's landmark in :attr:`ExportScene.points_m`, -1 for none.
    """

    timestamp_s: float
    T_world_camera: Floats
    keypoints_px: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    point_rows: Ints = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class ExportScene:
    """One map in its own world frame and its own metres.

    Attributes:
        name: of the recording.
        trajectory: every frame that has a pose.
        views: the keyframes, in order of time.
        camera: of the frames as the tracker saw them, with distortion; None where only the recording knows.
        points_m: ``(P, 3)`` landmarks; none where they were not kept.
        readout_s: readout time of the rolling shutter in seconds, 0 for a global one.
        gravity_w: ``(3,)`` unit direction of gravity in the world frame, or None where it is unknown.
        mesh, cloud: files of the run, or None where it has none.
        scale: where the metres come from, and how sure they are, as a sentence.
    """

    name: str
    trajectory: Trajectory
    views: tuple[View, ...]
    camera: Camera | None = None
    points_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    readout_s: float = 0.0
    gravity_w: Floats | None = None
    mesh: Path | None = None
    cloud: Path | None = None
    scale: str = "not known"

    @classmethod
    def of(
        cls,
        reconstruction: Reconstruction,
        name: str,
        *,
        mesh: Path | None = None,
        cloud: Path | None = None,
        scale: str = "not known",
    ) -> ExportScene:
        """The scene of a finished reconstruction.

        Args:
            name: of the recording.
            mesh, cloud: files that were written of it; taken where they exist.
            scale: see :class:`ExportScene`.
        """
        views = tuple(
            View(
                one.frame.timestamp_s,
                one.T_world_camera,
                one.keypoints_px if len(one.point_rows) else np.zeros((0, 2)),
                one.point_rows,
            )
            for one in reconstruction.keyframes
        )
        return cls(
            name,
            reconstruction.trajectory,
            views,
            reconstruction.keyframes[0].frame.camera if reconstruction.keyframes else None,
            reconstruction.points_m,
            reconstruction.statistics.readout_s or 0.0,
            reconstruction.gravity_w,
            _existing(mesh),
            _existing(cloud),
            scale,
        )

    @property
    def has_tracks(self) -> bool:
        """Whether it is known which keypoints see which landmark."""
        return any((view.point_rows >= 0).any() for view in self.views)

    def with_all_frames(self) -> ExportScene:
        """The scene with a view of every frame that has a pose; only keyframes have keypoints."""
        of_time = {view.timestamp_s: view for view in self.views}
        rows = zip(self.trajectory.timestamps_s.tolist(), self.trajectory.T_world_camera, strict=True)
        views: Sequence[View] = [of_time.get(time_s) or View(time_s, T) for time_s, T in rows]
        return replace(self, views=tuple(views))


def _existing(path: Path | None) -> Path | None:
    return path if path is not None and path.is_file() else None
