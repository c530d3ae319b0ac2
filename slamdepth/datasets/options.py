# SPDX-License-Identifier: Apache-2.0
"""What may be asked of a sequence when it is opened."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamdepth.errors import ConfigError

STALL_S = 10.0
"""A live source without a frame for so long has ended."""


@dataclass(frozen=True)
class ReadOptions:
    """How a sequence is opened; what a layout has no use for is ignored by it.

    Attributes:
        topic: image topic of a bag; None takes the likeliest colour camera.
        depth_topic: topic of a bag with depth registered to that camera; None takes the one next to it.
        pose_topic: topic of a bag that is ground truth: poses, odometry or ``/tf``; None reads none.
        follow_links: lists and links of the sequence may lead out of its folder.
        seconds: read no more than this much of the recording; None reads all.
        stall_s: a live source that gives no frame for so long has ended.

    Raises:
        ConfigError: a time is not positive and finite.
    """

    topic: str | None = None
    depth_topic: str | None = None
    pose_topic: str | None = None
    follow_links: bool = False
    seconds: float | None = None
    stall_s: float = STALL_S

    def arguments(self) -> list[str]:
        """What the command line was given for it."""
        given = (
            ("--topic", self.topic),
            ("--depth-topic", self.depth_topic),
            ("--pose-topic", self.pose_topic),
            ("--seconds", None if self.seconds is None else f"{self.seconds:g}"),
        )
        arguments = [text for name, value in given if value is not None for text in (name, value)]
        return [*arguments, "--follow-links"] if self.follow_links else arguments

    def __post_init__(self) -> None:
        for name, value in (("--seconds", self.seconds), ("stall_s", self.stall_s)):
            if value is not None and not 0 < value < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {value:g}")
