# SPDX-License-Identifier: Apache-2.0
"""The interface of a system under test."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from slamdepth.types import Frame, Trajectory


class NotInstalled(Exception):
    """A peer's package is missing; the text says how to install it."""


@dataclass(frozen=True)
class Estimate:
    """The result of a system.

    Attributes:
        trajectory: poses of all tracked frames, after the system's own optimisation.
        keyframes: poses of the keyframes; None where the system does not name them.
        counts: other counts by name, such as loops.
        notes: notes below the table, one line each.
    """

    trajectory: Trajectory
    keyframes: Trajectory | None = None
    counts: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class System(Protocol):
    """One SLAM or odometry program; it is built outside the measured time."""

    def step(self, frame: Frame) -> None:
        """Track the next frame; it has ``depth_m`` where the row asks for depth."""
        ...

    def finish(self) -> Estimate:
        """Do the final optimisation and hand over the poses."""
        ...
