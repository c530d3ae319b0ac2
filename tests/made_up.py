# SPDX-License-Identifier: Apache-2.0
"""A dataset and a tracker made up for the tests of the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.errors import CameraError, ImageDecodeError
from slamdepth.geometry import invert
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.mapstore import Map
from slamdepth.tracking.tracker import Tracker
from slamdepth.types import Camera, Frame, RunStatistics, StepResult, TrackingStatus, Trajectory

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)


class MadeUpDataset(Dataset):
    """Frames numbered by their grey value; some images or depth images do not decode."""

    name = "made-up"
    path = Path("made-up")
    camera = CAMERA
    has_depth = True

    def __init__(self, count: int, broken: tuple[int, ...] = (), broken_depth: tuple[int, ...] = ()) -> None:
        self.timestamps_s = np.arange(count) / 10.0
        self.broken, self.broken_depth = broken, broken_depth
        self.without_depth: tuple[int, ...] = ()
        self.ground_truth: Trajectory | None = None
        self.notes: list[str] = []
        self.wrong_size: int | None = None

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        if index in self.broken:
            raise ImageDecodeError(f"{index}.png: the image does not decode")
        if index == self.wrong_size:
            raise CameraError(f"{index}.png: the image is 9x9, the camera says 8x6")
        depth_m = None
        if with_depth and index in self.broken_depth:
            raise ImageDecodeError(f"depth/{index}.png: the image does not decode")
        if with_depth and index not in self.without_depth:
            depth_m = np.full((6, 8), 1.0 + index, np.float32)
        image = np.full((6, 8, 3), index % 256, np.uint8)
        return Frame(index, float(self.timestamps_s[index]), image, CAMERA, depth_m)


def pose(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


class MadeUpTracker:
    """Moves 1 m a frame; loses the frames of ``lost``."""

    def __init__(self, lost: tuple[int, ...] = (), on_step: Callable[[Frame], None] | None = None) -> None:
        self.lost, self.on_step = lost, on_step or (lambda frame: None)
        self.seen: list[int] = []
        self.closed = False

    def prepare(self, frame: Frame) -> int:
        return frame.index

    def step(self, frame: Frame, prepared: int | None = None) -> StepResult:
        assert prepared in (None, frame.index)
        self.on_step(frame)
        self.seen.append(frame.index)
        is_lost = frame.index in self.lost
        status = TrackingStatus.LOST if is_lost else TrackingStatus.TRACKING
        return StepResult(frame.index, frame.timestamp_s, status, None if is_lost else pose(frame.index))

    def ask_for_snapshot(self) -> None:
        """It has no map."""

    def take_snapshot(self) -> None:
        return None

    def __enter__(self) -> MadeUpTracker:
        return self

    def __exit__(self, *error: object) -> None:
        self.closed = True

    def finish(self) -> Reconstruction:
        placed = [i for i in self.seen if i not in self.lost]
        trajectory = Trajectory(np.array(placed) / 10.0, np.array([pose(i) for i in placed]))
        statistics = RunStatistics(len(self.seen), len(placed), timings_ms={"tracking": 1.0})
        return Reconstruction(trajectory, (), np.zeros((0, 3)), statistics=statistics)


class TwoMapTracker(Tracker):
    """The real tracker, whose result is cut into two maps at frame ``CUT``."""

    CUT = 16

    def step(self, frame: Frame, prepared: object = None) -> StepResult:
        result = super().step(frame, prepared)  # type: ignore[arg-type]
        return replace(result, map_id=int(frame.index >= self.CUT))

    def finish(self) -> Reconstruction:
        whole = super().finish()
        first, second = _part(whole, slice(None, self.CUT)), _part(whole, slice(self.CUT, None))
        return replace(first, others=(second,))

    def saved_map(self, number: int, *arguments: Any, **options: Any) -> Map:
        return super().saved_map(0, *arguments, **options)  # there is one map in truth


def _part(whole: Reconstruction, frames: slice) -> Reconstruction:
    """Some frames of a reconstruction, in the frame of the first of them."""
    path = whole.trajectory
    times_s, poses = path.timestamps_s[frames], path.T_world_camera[frames]
    T = invert(poses[0])
    keyframes = tuple(
        replace(keyframe, T_world_camera=T @ keyframe.T_world_camera)
        for keyframe in whole.keyframes
        if keyframe.frame.timestamp_s in times_s
    )
    return replace(
        whole,
        trajectory=replace(path, timestamps_s=times_s, T_world_camera=T @ poses),
        keyframes=keyframes,
        statistics=replace(whole.statistics, tracked=len(times_s)),
    )
