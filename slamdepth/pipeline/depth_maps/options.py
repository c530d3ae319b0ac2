# SPDX-License-Identifier: Apache-2.0
"""What is asked for when depth maps are made, and what comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamdepth.datasets import ReadOptions
from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.pipeline.options import check_frames_asked

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many shots are done, and how many there are (0 = unknown)."""


@dataclass(frozen=True)
class DepthMapOptions:
    """What is asked for.

    Attributes:
        source: an image, a folder of images, a video, or a sequence of a known layout.
        output: folder for the results; None makes ``depth/<name>``.
        depth, weights: the depth model's name, and its weights file where it is not the usual one.
        camera_file: a ``camera.yaml``, which overrules everything else.
        stride, max_frames: every Nth image, and at most this many.
        colour_range: near and far end of the colours in metres; None finds them.
        cloud: also write point clouds, by far the largest files.
        device: where the network runs.
        overwrite: earlier depth maps in ``output`` may be replaced.
        reading: how a sequence is opened.

    Raises:
        ConfigError: a number is out of range.
    """

    source: Path
    output: Path | None = None
    depth: str = "auto"
    weights: Path | None = None
    camera_file: Path | None = None
    stride: int = 1
    max_frames: int | None = None
    colour_range: tuple[float, float] | None = None
    cloud: bool = True
    device: str = "cpu"
    overwrite: bool = False
    reading: ReadOptions | None = None

    def __post_init__(self) -> None:
        check_frames_asked(self.stride, self.max_frames)
        if self.colour_range is not None:
            near, far = self.colour_range
            if not (0 <= near < far < float("inf")):
                raise ConfigError(
                    f"the range of colours must rise from near (0 or more) to far, got {near:g} to {far:g} m"
                )


@dataclass(frozen=True)
class DepthMapResult:
    """What was made.

    Attributes:
        folder: the folder of depth maps.
        about: the content of its ``depth.json``.
    """

    folder: Path
    about: dict[str, Any]


class DepthMapsInterrupted(SlamdepthError):
    """Stopped before the last image. What is done stays, and the same call goes on from there."""

    exit_code = 130
