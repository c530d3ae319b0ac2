# SPDX-License-Identifier: Apache-2.0
"""What is asked for when depth maps are made, and what comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamdepth.errors import ConfigError, SlamdepthError

Progress = Callable[[str, int, int], None]
"""Told what is being done, how many shots are, and how many there will be (0 = not known)."""


@dataclass(frozen=True)
class DepthMapOptions:
    """What is asked for.

    Attributes:
        source: an image, a folder of images, a video, or a sequence of a known layout.
        output: folder for the results; None makes ``depth/<name>``.
        depth, weights: the depth model's name, and its weights file where it is not the usual one.
        camera_file: a ``camera.yaml`` that overrules what else is known.
        stride, max_frames: every so-manieth image, no more than so many.
        colour_range: near and far end of the colours in metres; None finds them.
        cloud: also write point clouds, by far the largest files.
        overwrite: earlier depth maps in ``output`` may be replaced.
    """

    source: Path
    output: Path | None = None
    depth: str = "dinov2"
    weights: Path | None = None
    camera_file: Path | None = None
    stride: int = 1
    max_frames: int | None = None
    colour_range: tuple[float, float] | None = None
    cloud: bool = True
    device: str = "cpu"
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise ConfigError(f"the stride must be 1 or more, got {self.stride}")
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"the number of frames must be 1 or more, got {self.max_frames}")
        if self.colour_range is not None:
            near, far = self.colour_range
            if not (0 <= near < far < float("inf")):
                raise ConfigError(
                    f"the range of colours must rise from near (0 or more) to far, got {near:g} to {far:g} m"
                )


@dataclass(frozen=True)
class DepthMapResult:
    """What is in the folder now: ``about`` is the content of its ``depth.json``."""

    folder: Path
    about: dict[str, Any]


class DepthMapsInterrupted(SlamdepthError):
    """Stopped before the last image; what is done stays, and the same call goes on."""

    exit_code = 130
