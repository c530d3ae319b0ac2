# SPDX-License-Identifier: Apache-2.0
"""What a run is asked for beside its settings, and what it tells while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.types import TrackingStatus


@dataclass(frozen=True)
class RunOptions:
    """One run, beside its :class:`slamdepth.config.Config`.

    Attributes:
        sequence: folder of the sequence.
        output: run folder; None makes ``runs/<sequence>-<time>``.
        camera_file: a ``camera.yaml`` that overrules what the sequence says.
        max_frames: stop after so many frames; None reads all.
        stride: take every so-manieth frame.
        mesh: fuse the keyframes and write ``mesh.ply``.
        overwrite: an earlier run in ``output`` may be replaced.
    """

    sequence: Path
    output: Path | None = None
    camera_file: Path | None = None
    max_frames: int | None = None
    stride: int = 1
    mesh: bool = True
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise ConfigError(f"the stride must be 1 or more, got {self.stride}")
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"the number of frames must be 1 or more, got {self.max_frames}")

    def indices(self, frames: int) -> range:
        """Which of ``frames`` frames are read, in order."""
        chosen = range(0, frames, self.stride)
        return chosen if self.max_frames is None else chosen[: self.max_frames]


class Stage(str, Enum):
    """What a run is doing."""

    SCALING = "fitting the scale"
    TRACKING = "tracking"
    OPTIMISING = "optimising"
    MESHING = "meshing"
    SCORING = "scoring"


@dataclass(frozen=True)
class RunProgress:
    """State of a run, told after each frame and at each new stage.

    Attributes:
        done, total: frames while tracking and fitting, keyframes while meshing.
        fps: frames per second so far.
        status: of the last frame, None before the first.
    """

    stage: Stage
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
        folder: the run folder.
        summary: the content of ``report.json``.
        interrupted: True where it was stopped before the last frame.
    """

    folder: Path
    summary: dict[str, Any]
    interrupted: bool


class RunInterrupted(SlamdepthError):
    """The run was stopped before its first frame, so there is nothing to save."""

    exit_code = 130
