# SPDX-License-Identifier: Apache-2.0
"""What a system under test is, to the harness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from slamdepth.types import Frame, Trajectory


class NotInstalled(Exception):
    """A peer's package is missing; the text says how to install it."""


@dataclass(frozen=True)
class Estimate:
    """What a system knows in the end.

    Attributes:
        trajectory: every frame it placed, after its own optimisation.
        keyframes: its keyframes alone, where it says which they are.
        counts: what else it counts, by name.
        notes: what a reader of the table should know, one line each.
    """

    trajectory: Trajectory
    keyframes: Trajectory | None = None
    counts: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class System(Protocol):
    """One SLAM or odometry program; built outside the measured time."""

    def step(self, frame: Frame) -> None:
        """Take in the next frame, with ``depth_m`` where the row says so."""
        ...

    def finish(self) -> Estimate:
        """Optimise what is left to optimise and hand over the poses."""
        ...
