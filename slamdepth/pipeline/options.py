# SPDX-License-Identifier: Apache-2.0
"""What a run is asked for in addition to its settings, what it reports while it works, what it returns."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.datasets.options import ReadOptions
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.types import TrackingStatus, Trajectory

CHECKPOINT_S = 15.0
"""Seconds from one checkpoint of a run to the next."""


@dataclass(frozen=True)
class RunOptions:
    """One run, in addition to its :class:`slamdepth.config.Config`.

    Attributes:
        sequence: a video or the folder of a sequence.
        output: run folder; None makes ``runs/<sequence>-<time>``.
        camera_file: a ``camera.yaml`` that overrules what the sequence says.
        view_deg: field of view across the longer side of an image, which overrules it too.
        max_frames: stop after this many frames; None reads all.
        stride: take every Nth frame.
        mesh: fuse the keyframes and write ``mesh.ply`` and ``cloud.ply``.
        overwrite: an earlier run in ``output`` may be replaced.
        start_map: a run whose map this run goes on from.
        map_images: keep images in the map.
        checkpoint_s: seconds from one checkpoint to the next; 0 writes none.
        reading: how the sequence is opened, such as the topic of a bag.
        exports: formats that the result is exported to, see :func:`slamdepth.export_run`.

    Raises:
        ConfigError: ``stride`` or ``max_frames`` is below 1, or both a camera file and a view are given.
    """

    sequence: Path
    output: Path | None = None
    camera_file: Path | None = None
    max_frames: int | None = None
    stride: int = 1
    mesh: bool = True
    overwrite: bool = False
    start_map: Path | None = None
    map_images: bool = False
    checkpoint_s: float = CHECKPOINT_S
    reading: ReadOptions = field(default_factory=ReadOptions)
    exports: tuple[str, ...] = ()
    view_deg: float | None = None

    def __post_init__(self) -> None:
        check_frames_asked(self.stride, self.max_frames)
        if not 0.0 <= self.checkpoint_s < math.inf:
            raise ConfigError(f"checkpoints must be 0 or more seconds apart, got {self.checkpoint_s:g}")
        if self.camera_file is not None and self.view_deg is not None:
            raise ConfigError("a camera file and a field of view exclude each other")

    def indices_of(self, dataset: Dataset) -> range:
        """Which frames of ``dataset`` are read, in order; of a live source, all that there may ever be."""
        if dataset.is_live:
            return self.indices(sys.maxsize)
        times_s = dataset.timestamps_s
        if self.reading.seconds is None or not len(times_s):
            return self.indices(len(dataset))
        end_s = float(times_s[0]) + self.reading.seconds
        return self.indices(int(np.searchsorted(times_s, end_s, side="right")))

    def indices(self, frames: int) -> range:
        """Which of ``frames`` frames are read, in order."""
        chosen = range(0, frames, self.stride)
        return chosen if self.max_frames is None else chosen[: self.max_frames]


def check_frames_asked(stride: int, max_frames: int | None) -> None:
    """Refuse a stride or a number of frames below 1.

    Raises:
        ConfigError: one of them is.
    """
    if stride < 1:
        raise ConfigError(f"the stride must be 1 or more, got {stride}")
    if max_frames is not None and max_frames < 1:
        raise ConfigError(f"the number of frames must be 1 or more, got {max_frames}")


class RunStage(str, Enum):
    """What a run is doing."""

    CALIBRATING = "finding the focal length"
    SCALING = "fitting the scale"
    TRACKING = "tracking"
    OPTIMISING = "optimising"
    MARKERS = "looking for markers"
    DENSE = "measuring depth from many views"
    MESHING = "meshing"
    DRAWING = "drawing the mesh"
    SCORING = "scoring"
    COMPARING = "scoring the mesh"
    EXPORTING = "exporting"
    REPORTING = "writing the report"


@dataclass(frozen=True)
class RunProgress:
    """State of a run, reported after each frame and at the start of each stage.

    Attributes:
        stage: what the run is doing.
        done, total: frames while tracking, fitting, looking for markers and scoring the mesh, keyframes
            while meshing, images while exporting, steps of the work while measuring depth.
        fps: frames per second so far.
        status: of the last frame, None before the first.
        keyframes, loop_closures: totals so far.
    """

    stage: RunStage
    done: int = 0
    total: int = 0
    fps: float = 0.0
    status: TrackingStatus | None = None
    keyframes: int = 0
    loop_closures: int = 0


ProgressCallback = Callable[[RunProgress], None]


@dataclass(frozen=True)
class RunResult:
    """What a run left behind.

    Attributes:
        folder: the run folder; its ``README.txt`` explains each file.
        summary: the content of ``report.json``: counts, scores, versions, settings.
        reconstruction: trajectory, keyframes and map points at their final scale, as they were written: the
            largest map, and in ``others`` those that never met it. Images and depth of the keyframes stay in
            memory or in a temporary file as long as it is kept.
        interrupted: True where the run was stopped before the last frame.
    """

    folder: Path
    summary: dict[str, Any]
    reconstruction: Reconstruction = field(repr=False)
    interrupted: bool = False

    @property
    def trajectory(self) -> Trajectory:
        """Every frame placed in the largest map, after optimisation, as in ``trajectory.txt``."""
        return self.reconstruction.trajectory


class RunInterrupted(SlamdepthError):
    """The run was stopped before its first frame, so there is nothing to save."""

    exit_code = 130
