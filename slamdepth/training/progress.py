# SPDX-License-Identifier: Apache-2.0
"""Progress reports of a training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class TrainStep:
    """Progress within one stage of a training.

    Attributes:
        stage: unique name of the stage.
        done, total: in units of about the same duration throughout the stage.
        detail: text to show with it, such as the epoch and the loss.
    """

    stage: str
    done: float
    total: float
    detail: str = ""


Progress = Callable[[TrainStep], None]


def silent(step: TrainStep) -> None:
    """A :data:`Progress` that does nothing."""
